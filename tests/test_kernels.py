"""The count of kernels that an update launches: what counts, and under which purpose."""

import pytest
import torch

from benchmarks import kernels
from components.core.draws import Normal
from components.core.random_streams import LaneStreams
from components.networks import polyak_update
from components.training.loop import adam
from tests.test_benchmarks import cells


def test_products_count_by_their_launches_and_views_not_at_all() -> None:
    weight = torch.zeros(2, 3, 4, requires_grad=True)

    def run() -> None:
        out = torch.baddbmm(torch.zeros(2, 1, 4), torch.ones(2, 5, 3), weight)[:, 1:].mT
        torch.relu_(out).sum().backward()

    by_kind, by_name = kernels.kernels(run)
    assert by_name["baddbmm"] == 2  # the bias is copied first
    assert by_name["relu_"] == 1
    assert by_kind["matrix products"] == 2 + by_name["bmm"]
    assert by_name["bmm"] == 1  # the gradient of the weights alone
    assert not {"slice", "transpose", "view", "empty", "detach", "expand"} & set(by_name)


def test_a_list_of_tensors_is_one_kernel_of_its_own_purpose() -> None:
    network, target = (torch.nn.Linear(3, 2) for _ in range(2))
    optimizer = adam(network.parameters(), 1e-3)
    network(torch.ones(1, 3)).sum().backward()
    optimizer.step()  # makes its moments
    by_kind, _ = kernels.kernels(optimizer.step)
    assert dict(by_kind) == {"optimiser": 2}  # step counters, then parameters and moments
    by_kind, _ = kernels.kernels(lambda: polyak_update([(target, network)], 0.1))
    assert dict(by_kind) == {"targets": 1}


def test_what_the_streams_compute_counts_as_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    streams = LaneStreams([1], {"noise": Normal(2)}, torch.device("cpu"))
    at = LaneStreams.at
    monkeypatch.setattr(LaneStreams, "at", lambda own, step: {"noise": at(own, step)["noise"] + 1})
    by_kind, _ = kernels.kernels(lambda: streams.at(0)["noise"] * 2.0)
    assert by_kind[kernels.DRAWS] >= 1
    assert by_kind[kernels.REST] == 1


def test_a_row_per_learner_adds_up() -> None:
    head, bc, td3_bc = cells(kernels.report(["bc", "td3_bc"], operations=True))
    assert head == ["learner", "kernels", *kernels.KINDS, "operations"]
    for row in (bc, td3_bc):
        counts = [int(cell.replace(",", "")) for cell in row[1:-1]]
        assert counts[0] == pytest.approx(sum(counts[1:]), abs=3)  # means of two, rounded
    # Two updates of TD3+BC, one of them with the actor: three passes of three layers for the
    # critics' targets and values, and in one of two updates two more for the actor.
    assert int(bc[1]) < int(td3_bc[1])
    assert "baddbmm" in td3_bc[-1]


def test_stacks_are_not_cut_for_a_cache() -> None:
    dataset = kernels.Settings(quick=True).dataset()
    made = kernels.learner_as_on_a_gpu("cql", dataset)
    assert [lanes for lanes, _ in made._groups] == [slice(0, 2)]


def test_an_unknown_learner_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["kernels", "bc", "sarsa"])
    with pytest.raises(SystemExit) as error:
        kernels.main()
    assert error.value.code == 2
    assert "no learner is called sarsa; there are bc, " in capsys.readouterr().err
