"""The logic of graphs, on a processor: what is staged, what is frozen, what is lost."""

import gc
from collections.abc import Callable
from contextlib import nullcontext

import pytest
import torch
from torch import Tensor

from components.core.draws import Normal
from components.core.random_streams import LaneStreams
from components.models.recurrent_ensemble import fit as recurrent_fit
from components.models.recurrent_ensemble.ensemble import RecurrentEnsembleConfig
from components.models.recurrent_ensemble.windows import TrainingWindows
from components.models.supervised import StackedFit
from components.training import cuda_graphs
from components.training.cuda_graphs import GraphedLearner, graphed, lost_graphs
from components.training.loop import Curves, Learner, TrainingLoop
from components.training.recorded import RecordedGraphs
from tests.components.models.test_supervised import Points, fitting, pulled
from tests.components.synthetic import CPU, make_log

UPDATES = 47


def rate_in_memory(made: object) -> None:
    """Keep the learning rate as on a GPU."""
    for group in made._optimizer.param_groups:
        group["lr"] = torch.tensor(group["lr"])


def falling(kind: type = StackedFit) -> StackedFit[Points]:
    """A fit with a schedule, as on a GPU."""
    streams = LaneStreams([1, 2], {"place": Normal(2, 3)}, CPU)
    made = kind(Points(2), 2, pulled, streams, learning_rate=0.1, schedule="cosine")
    made._updates = UPDATES
    rate_in_memory(made)
    return made


def trained(learner: Learner) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """State and curves after all updates, by graphs of 5 and, at the end, 2."""
    curves = TrainingLoop(UPDATES, "ab", log_every=15).run(learner, at=())
    return learner.state_dict(), curves.tensors()


def assert_same(graphs: Learner, plain: Learner) -> None:
    for found, expected in zip(trained(graphs), trained(plain), strict=True):
        assert found.keys() == expected.keys()
        for key, tensor in expected.items():
            assert torch.equal(found[key], tensor), key


def test_runs_follow_the_schedule_and_the_draws() -> None:
    graphs = GraphedLearner(falling(), RecordedGraphs())
    assert_same(graphs, falling())
    assert graphs.captured == 2, "of five updates, a third of an interval, and of two at the end"


def test_a_recurrent_fit_does_too() -> None:
    config = RecurrentEnsembleConfig(
        members=2, hidden=4, warm_up=3, horizon=4, updates=12, batch=4, validate_every=6
    )
    windows = TrainingWindows(make_log(), config, CPU)

    def fit() -> Learner:
        made = recurrent_fit._EnsembleLearner(windows, config, 1, CPU)
        rate_in_memory(made)
        return made

    states = []
    for learner in (fit(), GraphedLearner(fit(), RecordedGraphs())):
        TrainingLoop(12, [str(n) for n in range(learner.lanes)], log_every=6).run(learner)
        states.append(learner.state_dict())
    for key, tensor in states[0].items():
        assert torch.equal(states[1][key], tensor), key


class Frozen(StackedFit[Points]):
    """Uses its step number, but says that all steps are alike."""

    def update(self, step: int) -> dict[str, Tensor]:
        return super().update(step) | {"step": torch.ones(2) * step}


def test_what_is_not_staged_stays_as_it_was_recorded() -> None:
    _, expected = trained(falling(Frozen))
    _, found = trained(GraphedLearner(falling(Frozen), RecordedGraphs()))
    assert expected["step"][0].tolist() == [7.0, 22.0, 37.0]
    # The run of five is recorded at steps 5 to 9 and repeated from 10 on.
    assert found["step"][0, 2] < 30.0


class Waiting(StackedFit[Points]):
    def update(self, step: int) -> dict[str, Tensor]:
        made = super().update(step)
        float(made["mean"].sum())
        return made


def test_what_cannot_be_captured_goes_on_as_it_is_and_is_told() -> None:
    graphs = GraphedLearner(falling(Waiting), RecordedGraphs())
    with (
        lost_graphs() as lost,
        pytest.warns(UserWarning, match="No CUDA graph for .*updates.* of .*test_recorded: aten"),
    ):
        assert_same(graphs, falling(Waiting))
    assert graphs.captured == 0
    said = "aten::_local_scalar_dense reads a number on the host"
    assert lost == [f"5 updates at once: {said}", f"updates: {said}"]


def test_losing_graphs_outside_of_a_block_is_told_by_a_warning_alone() -> None:
    with lost_graphs() as lost:
        pass
    with pytest.warns(UserWarning, match="No CUDA graph"):
        trained(GraphedLearner(falling(Waiting), RecordedGraphs()))
    assert lost == []


ROOM = 600  # operations: the draws are 500 of them, an update is 25


class Small(RecordedGraphs):
    """Has no room for more than some operations."""

    def capture(self, run: Callable[[], None]) -> Callable[[], None]:
        replay = super().capture(run)
        if len(replay.args[0]) > ROOM:
            try:
                raise RuntimeError("out of room\nand more")
            except RuntimeError as error:
                raise RuntimeError("the capture ended") from error
        return replay


def test_if_several_updates_are_too_many_single_ones_are_captured() -> None:
    graphs = GraphedLearner(falling(), Small())
    with lost_graphs() as lost, pytest.warns(UserWarning, match="5 updates at once"):
        assert_same(graphs, falling())
    assert lost == ["5 updates at once: out of room"], "what ended the capture, in one line"
    assert graphs.captured == 1


def test_single_updates_can_be_asked_for() -> None:
    graphs, plain = GraphedLearner(falling(), RecordedGraphs()), falling()
    for step in range(9):
        for name, value in graphs.update(step).items():
            assert torch.equal(value, plain.update(step)[name]) if name == "mean" else True
    assert graphs.captured == 1


def test_a_resumed_training_by_graphs_is_the_whole_one(tmp_path: object) -> None:
    expected = trained(falling())
    path = tmp_path / "c.safetensors"

    def die(done: int, curves: Curves) -> bool:
        raise RuntimeError("killed")

    loop = TrainingLoop(UPDATES, "ab", path, log_every=15, save_every=0.0)
    with pytest.raises(RuntimeError, match="killed"):
        loop.run(GraphedLearner(falling(), RecordedGraphs()), die, {37})
    last = GraphedLearner(falling(), RecordedGraphs())
    curves = loop.run(last, at=())
    for found, wanted in zip((last.state_dict(), curves.tensors()), expected, strict=True):
        for key, tensor in wanted.items():
            assert torch.equal(found[key], tensor), key


def test_recording_does_nothing() -> None:
    place, made = torch.ones(3), []

    def run() -> None:
        place.add_(1.0)
        made.append(place * 2.0)

    replay = RecordedGraphs().capture(run)
    assert place.tolist() == [1.0] * 3
    replay()
    place.fill_(5.0)
    replay()
    assert (place.tolist(), made[0].tolist()) == ([6.0] * 3, [12.0] * 3)


@pytest.mark.parametrize(
    "run",
    [
        lambda: torch.ones(3)[torch.tensor([1.0, 0.0, 1.0]) > 0.5],
        lambda: torch.tensor([1.0, 2.0]),
        lambda: torch.ones(2).nonzero(),
        lambda: bool(torch.ones(())),
    ],
)
def test_waiting_for_the_host_is_refused(run: Callable[[], object]) -> None:
    with pytest.raises(RuntimeError, match=r"aten::.* the host"):
        RecordedGraphs().capture(run)


def test_on_a_processor_learners_stay_as_they_are() -> None:
    made = fitting("a")
    assert graphed(made, CPU) is made


@pytest.mark.parametrize("failures", [0, 1, 2])
def test_a_capture_is_tried_twice_without_garbage_collection(
    failures: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Graph:
        def replay(self) -> None: ...

    tries: list[bool] = []

    def capturing(graph: Graph, **options: object) -> object:
        assert options["capture_error_mode"] == "thread_local"
        return nullcontext()

    def run() -> None:
        tries.append(gc.isenabled())
        if len(tries) <= failures:
            raise RuntimeError("captured in vain")

    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", capturing)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(cuda_graphs.torch.cuda, "Stream", lambda device: Graph())
    monkeypatch.setattr(Graph, "device", CPU, raising=False)
    graphs = cuda_graphs.CudaGraphs(CPU)
    if failures < 2:
        assert graphs.capture(run).__name__ == "replay"
    else:
        with pytest.raises(RuntimeError, match="in vain"):
            graphs.capture(run)
    assert tries == [False] * min(failures + 1, 2)
    assert gc.isenabled()
