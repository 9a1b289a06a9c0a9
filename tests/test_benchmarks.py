"""The speed benchmarks run, compare like with like and print their tables; no speed is asserted."""

import ast
import json
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import __main__ as all_benchmarks
from benchmarks import (
    ensemble_quality,
    environment,
    experts,
    lanes,
    measure,
    model_free,
    peer_d3rlpy,
    pipeline,
    recurrent,
    robots,
    wsbc,
)
from components.algorithms import ALGORITHMS
from components.core.random_streams import LaneStreams, lane_key
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate
from components.environments.mujoco.specifications import HOPPER
from components.evaluation.protocol import EvaluationProtocol
from components.experts.config import ExpertConfig
from components.models.recurrent_ensemble.ensemble import RecurrentEnsembleConfig
from components.models.transition.model_environment import DynamicsSpecification

TINY = RecurrentEnsembleConfig(members=2, hidden=5, warm_up=4, horizon=6, batch=7)
SETTINGS = {
    "td3_bc": {"hidden": (8,), "batch": 16},
    "lion": {"hidden": (8,), "trajectories": 6, "horizon": 5},
}


def cells(table: str) -> list[list[str]]:
    """A Markdown table without its rule."""
    lines = [line for line in table.splitlines() if line.startswith("|")]
    return [[c.strip() for c in line.strip("|").split("|")] for line in lines if "---" not in line]


def test_environment_benchmark_prints_a_table(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["environment", "--copies", "20", "--seconds", "0.01"])
    environment.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("| environment | copies | steps per second |")
    copies = [line.split("|")[2].strip() for line in lines[2:9]]
    assert copies == ["1", "1", "1", "10", "20", "100", "200"]
    assert "NumPy" in lines[-1]


def test_robots_table() -> None:
    header, *rows = cells(robots.report(copies=3, episodes=2, repetitions=1))
    assert header[0] == "robot"
    assert [row[0] for row in rows[::3]] == ["Swimmer-v0", "Hopper-v0", "Walker2d-v0"]
    assert [row[3] for row in rows[::3]] == ["1.0"] * 3


def test_both_sides_of_the_robots_benchmark_earn_the_same() -> None:
    policy = robots.untrained_policy(HOPPER.id, hidden=(8,))
    protocol = EvaluationProtocol(trajectories=4, horizon=60)
    plain, steps = robots.plain_returns(policy, HOPPER.id, 4, protocol)
    together = robots.evaluated(policy, HOPPER.id, protocol, threads=2).returns[0, 0]
    # float32 sums in another order, over up to sixty steps of contact
    np.testing.assert_allclose(together, plain, rtol=1e-3)
    assert steps < 4 * 60, "some episodes end in a fall"
    assert robots._steps(policy, HOPPER.id, protocol) == steps


def test_the_runs_of_a_comparison_take_turns() -> None:
    order: list[str] = []
    runs = {"a": lambda: order.append("a"), "b": lambda: order.append("b")}
    seconds = measure.median_seconds(runs, repetitions=3)
    assert order == ["a", "b"] * 4  # the first round warms up
    assert set(seconds) == {"a", "b"}
    with pytest.raises(ValueError, match="repetitions is 0; give at least 1"):
        measure.median_seconds(runs, repetitions=0)


def test_lanes_table_relates_the_stack_to_the_programs_of_one_lane() -> None:
    updates = {"td3_bc": 1, "lion": 1}
    header, *rows = cells(lanes.report("cpu", 1, updates, trajectories=2, settings=SETTINGS))
    assert header[:2] == ["learner", "program"]
    programs = ["5 programs of 1 lane, in turn", "1 program of 5 lanes"]
    assert [row[:2] for row in rows] == [[name, p] for name in updates for p in programs]
    assert [row[4] for row in rows[::2]] == ["1.00", "1.00"]


@pytest.mark.parametrize("algorithm", ["td3_bc", "lion"])
def test_both_sides_of_the_lanes_benchmark_do_the_same_work(algorithm: str) -> None:
    dataset = generate(IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=2), seed=0)
    device = torch.device("cpu")
    stack = lanes.program(algorithm, dataset, range(5), device, **SETTINGS[algorithm])
    alone = lanes.program(algorithm, dataset, [3], device, **SETTINGS[algorithm])
    for step in range(2):
        stacked, single = stack.update(step), alone.update(step)
    assert single.keys() == stacked.keys()
    for name, value in single.items():
        # The same float32 sums in another order, after two updates.
        torch.testing.assert_close(stacked[name][3:4], value, rtol=1e-4, atol=1e-5)


def test_experts_table_relates_seed_updates_to_those_of_one_eager_seed() -> None:
    header, *rows = cells(experts.report(repetitions=1, steps=2, hidden=(8,)))
    assert header == ["robot", "program", "updates/s", "seed-updates/s", "times"]
    programs = ["eager, 1 seed", "ours, 1 lane", "ours, 4 lanes"]
    assert [row[:2] for row in rows] == [["swimmer", program] for program in programs]
    assert rows[0][4] == "1.00"


def test_the_eager_peer_of_the_experts_computes_the_same_update(tmp_path: Path) -> None:
    settings = ExpertConfig(
        steps=60, random_steps=50, evaluate_every=60, hidden=(8, 6), batch=20, target_rate=0.1
    )
    ours = experts.lanes_program(settings, "swimmer", [0], tmp_path)
    eager = experts.EagerDDPG(settings, "swimmer", 0)
    for step in range(50):
        ours.update(step)
        eager.step()
    assert eager.count == 50
    learner = ours._learner
    pairs = (
        (eager.actor, learner._actor),
        (eager.critic, learner._critic.stack),
        (eager.actor_target, learner._actor_target),
        (eager.critic_target, learner._critic_target.stack),
    )
    with torch.no_grad():
        for plain, stack in pairs:
            for layer, (weight, bias) in zip(plain[::2], stack.affine(), strict=True):
                layer.weight.copy_(weight[0].T)
                layer.bias.copy_(bias[0, 0])
    for _ in range(3):
        batch = ours._replay.batch(torch.randint(50, (1, settings.batch)))
        learner.learn(batch)
        moved = (batch.observations, batch.actions, batch.rewards, batch.next_observations)
        eager.update(*(part[0] for part in moved), 1.0 - batch.continues[0])
    for plain, stack in pairs:
        for layer, (weight, bias) in zip(plain[::2], stack.affine(), strict=True):
            # three Adam steps of 1e-3 in float32
            torch.testing.assert_close(layer.weight, weight[0].T, rtol=1e-3, atol=1e-5)
            torch.testing.assert_close(layer.bias, bias[0, 0], rtol=1e-3, atol=1e-5)


def test_the_plain_recurrent_loop_computes_what_the_stacked_scan_does() -> None:
    weight, readout, windows, targets = recurrent.random_problem(TINY, torch.device("cpu"))
    networks = recurrent.plain_networks(weight, readout)
    batch_major = [part.transpose(1, 2) for part in windows.unbind(dim=1)]
    plain = recurrent.plain_pass(networks, batch_major, targets, TINY.warm_up)
    stacked = recurrent.stacked_pass(
        weight.requires_grad_(), readout.requires_grad_(), windows, targets, TINY
    )
    # Ten steps of float32 sums in another order.
    torch.testing.assert_close(plain, stacked, rtol=1e-5, atol=1e-6)
    assert weight.grad is not None
    assert readout.grad is not None
    for m, network in enumerate(networks):
        # The own input of the second half is no parameter: it is always zero there.
        inputs = slice(None) if network.feeds_back else slice(-1)
        own = weight.grad[m, :, TINY.hidden : -1]
        torch.testing.assert_close(
            network.inputs.grad[:, inputs], own[:, inputs], rtol=1e-4, atol=1e-6
        )
        hidden = torch.cat([network.recurrent.grad, network.bias.grad[:, None]], dim=1)
        columns = [*range(TINY.hidden), -1]
        torch.testing.assert_close(hidden, weight.grad[m][:, columns], rtol=1e-4, atol=1e-6)
        emit = torch.cat([network.readout.grad, network.offset.grad[:, None]], dim=1)
        torch.testing.assert_close(emit, readout.grad[m], rtol=1e-4, atol=1e-6)


def test_recurrent_table() -> None:
    header, *rows = cells(recurrent.report("cpu", repetitions=1, passes=1, config=TINY))
    assert header[0] == "training pass"
    assert [row[0] for row in rows] == [
        "plain loop, one network at a time",
        "stacked scan, 4 networks",
    ]
    assert rows[0][-1] == "1.0"


SWARM = {"particles": 3, "neighbourhood": 3, "starts": 4, "horizon": 5}


def test_the_plain_loop_of_a_policy_s_return_computes_what_the_swarm_does() -> None:
    dataset = generate(IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=2), seed=0)
    settings = SWARM | {"particles": 1, "neighbourhood": 1}  # the clone alone
    learner = lanes.program("wsbc", dataset, [0], torch.device("cpu"), **settings)
    found = learner.update(0)["policy/virtual_return"]
    policy, ensemble = (lanes.UNTRAINED[n](dataset) for n in ALGORITHMS["wsbc"].needs)
    rule = DynamicsSpecification.of_card(dataset.card)
    starts = learner._starts([lane_key(dataset.card.name, "wsbc", 0)])
    [start] = learner._data.raw_histories(starts)
    plain = wsbc.plain_return(policy, ensemble, rule, start, 5, 0.97)
    # 34 recurrent steps of float32 sums in another order
    torch.testing.assert_close(plain, found[0], rtol=1e-5, atol=0)


def test_swarm_table() -> None:
    header, *rows = cells(wsbc.report(repetitions=1, trajectories=2, settings=SWARM))
    assert header[0] == "iteration"
    assert [row[0] for row in rows] == [
        "plain loop, one particle at a time",
        "swarm, 1 lane",
        "swarm, 5 lanes",
    ]
    assert rows[0][-1] == "1.0"


@pytest.mark.slow(2)
def test_pipeline_table_and_that_it_leaves_a_tracking_server_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = f"sqlite:///{tmp_path}/other.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", other)
    header, *rows = cells(pipeline.report(nodes=2, repetitions=1))
    assert header == ["empty node", "ms per node"]
    assert len(rows) == 3
    assert os.environ["MLFLOW_TRACKING_URI"] == other
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def log() -> OfflineDataset:
    return generate(IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=2), seed=0)


def test_a_missing_peer_is_one_sentence_that_says_how_to_install_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # Neither is nothing at all a peer nor a Python that lacks d3rlpy, such as this one.
    for peer in (tmp_path / "python", Path(sys.executable)):
        monkeypatch.setattr(sys, "argv", ["model_free", "--peer", str(peer)])
        with pytest.raises(SystemExit) as stopped:
            model_free.main()
        assert stopped.value.code == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err == (
            f"There is no Python with d3rlpy at {peer}; `make peers` installs one in .venv-peers.\n"
        )


@pytest.mark.parametrize("algorithm", peer_d3rlpy.COUNTERPARTS)
def test_the_clock_runs_past_the_warm_up_and_starts_with_a_draw_of_random_numbers(
    algorithm: str, log: OfflineDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[int] = []
    draws: list[int] = []  # steps that begin a block of random numbers
    config = ALGORITHMS[algorithm].config(hidden=(8,), batch=4)
    settings = {"hidden": config.hidden, "batch": config.batch}
    if hasattr(config, "vae_hidden"):
        settings["vae_hidden"] = (8,)
    at, keep = LaneStreams.at, LaneStreams._keep

    def watched_at(self: LaneStreams, step: int) -> dict[str, torch.Tensor]:
        steps.append(step)
        return at(self, step)

    def watched_keep(self: LaneStreams, words: Mapping[str, torch.Tensor]) -> None:
        draws.append(steps[-1])
        keep(self, words)

    monkeypatch.setattr(LaneStreams, "at", watched_at)
    monkeypatch.setattr(LaneStreams, "_keep", watched_keep)
    assert model_free.own_seconds(algorithm, log, 2, 3, settings) > 0
    assert steps == list(range(steps[0], steps[0] + model_free.WARM_UP + 3))
    assert draws == [steps[0], steps[model_free.WARM_UP]]
    longest = max(getattr(config, name, 0) for name in ("warm_up", "cloning"))
    assert steps[0] >= longest * config.updates


@pytest.mark.slow(6)
def test_our_side_is_measured_in_a_process_of_its_own(log: OfflineDataset, tmp_path: Path) -> None:
    log.write(tmp_path / "log")
    command = model_free.own_command(tmp_path / "log", "ddpg", lanes=2, updates=1, threads=1)
    answer = model_free.run(command, threads=1)
    assert answer["seconds"] > 0
    assert answer["torch"] == torch.__version__
    with pytest.raises(RuntimeError, match=r"exit code 1: .*There is no dataset in"):
        model_free.run(model_free.own_command(tmp_path, "ddpg", 1, 1, 1), threads=1)


def test_the_peer_gets_our_transitions_as_whole_histories(
    log: OfflineDataset, tmp_path: Path
) -> None:
    model_free.write_transitions(log, 1e-3, tmp_path / "log.npz")
    with np.load(tmp_path / "log.npz", allow_pickle=False) as stored:
        assert stored["observations"].shape == (log.transitions, 180)
        rows = np.array([0, 17, log.transitions - 1])
        batch = LaneData([log], torch.device("cpu"), 1e-3).batch(torch.from_numpy(rows)[None])
        assert np.array_equal(stored["observations"][rows], batch.observations[0])
        assert np.array_equal(stored["actions"][rows], batch.actions[0])
        assert np.array_equal(stored["rewards"][rows], batch.rewards[0])
        assert np.array_equal(1.0 - stored["terminals"][rows], batch.continues[0])
        assert np.array_equal(np.flatnonzero(stored["ends"]) + 1, log.episode_starts[1:])


@pytest.mark.parametrize("algorithm", peer_d3rlpy.COUNTERPARTS)
def test_the_peer_gets_our_settings(algorithm: str) -> None:
    config = ALGORITHMS[algorithm].config()
    command = model_free.peer_command(Path("python"), Path("log.npz"), algorithm, 7, threads=1)
    assert command[:2] == ["python", "-I"]
    settings = json.loads(command[4])
    assert settings == {"algorithm": algorithm, **json.loads(json.dumps(asdict(config)))}
    told = peer_d3rlpy.arguments(algorithm, settings)
    assert (told["batch_size"], told["gamma"]) == (config.batch, config.discount)
    widths = peer_d3rlpy.layers(algorithm, settings)
    assert widths["actor"] == widths["critic"] == list(config.hidden)
    assert widths.get("imitator") == (
        list(config.vae_hidden) if hasattr(config, "vae_hidden") else None
    )


def test_the_peer_script_needs_nothing_of_this_project() -> None:
    tree = ast.parse(Path(peer_d3rlpy.__file__).read_text(encoding="utf-8"))
    names = [n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    names += [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
    foreign = {name.split(".")[0] for name in names} - sys.stdlib_module_names
    assert foreign == {"d3rlpy", "numpy", "torch"}


def test_model_free_table_relates_seed_updates_to_those_of_the_peer() -> None:
    seconds = {"ddpg": [[1.0, 2.0, 9.0], [4.0] * 3, [5.0] * 3]}
    header, *rows = cells(model_free.table(seconds, {"ddpg": (100, 40, 50)}, "d3rlpy 2"))
    assert header == ["algorithm", "program", "updates/s", "seed-updates/s", "times d3rlpy"]
    assert rows == [
        ["ddpg", "ours, 1 lane", "50.0", "50.0", "5.00"],
        ["ddpg", "ours, 5 lanes", "10.0", "50.0", "5.00"],
        ["ddpg", "d3rlpy 2, 1 seed", "10.0", "10.0", "1.00"],
    ]


@pytest.mark.parametrize("beside", [True, False])
def test_all_benchmarks_are_printed_under_their_titles(
    beside: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    modules = (
        environment,
        robots,
        lanes,
        recurrent,
        ensemble_quality,
        wsbc,
        experts,
        pipeline,
        *[model_free] * beside,
    )
    for module in (*modules, model_free):
        monkeypatch.setattr(module, "report", lambda name=module.__name__: f"table of {name}")
    monkeypatch.setattr(model_free, "available", lambda: beside)
    monkeypatch.setattr(sys, "argv", ["benchmarks"])
    all_benchmarks.main()
    printed = capsys.readouterr().out
    assert "PyTorch" in printed.splitlines()[0]
    tables = [f"table of {module.__name__}" for module in modules]
    assert [line for line in printed.splitlines() if line.startswith("table of")] == tables
    assert printed.count("\n## ") == len(modules)
    skipped = f"Skipped the comparison with d3rlpy. {model_free.missing()}"
    assert (skipped in printed.splitlines()) is not beside


@pytest.mark.parametrize(("word", "code"), [("--help", 0), ("--nothing", 2)])
def test_whoever_asks_what_all_benchmarks_are_runs_none(
    word: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmarks", word])
    monkeypatch.setattr(environment, "report", lambda: pytest.fail("a benchmark runs"))
    with pytest.raises(SystemExit) as ended:
        all_benchmarks.main()
    assert ended.value.code == code


def test_reference_quality_is_the_first_time_all_targets_are_good_enough() -> None:
    steps = [1, 2, 3, 4]
    curves = {
        "fatigue": [(steps, [0.9, 0.3, 0.5, 0.1]), (steps, [0.9, 0.5, 0.4, 0.9])],
        "consumption": [(steps, [0.1, 0.9, 0.9, 0.9])],
    }
    # best so far of the fatigue networks: 0.9, 0.4, 0.35, 0.25 in the mean
    wanted = {"fatigue": 0.4, "consumption": 0.2}
    assert ensemble_quality.first_good(curves, wanted) == 1
    assert ensemble_quality.first_good(curves, wanted | {"fatigue": 0.3}) == 3
    assert ensemble_quality.first_good(curves, wanted | {"consumption": 0.05}) is None


def test_ensemble_quality_benchmark_prints_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    small = IndustrialSpec("mediocre-1.0", "mediocre", 1.0, trajectories=4, steps=40)
    monkeypatch.setattr(ensemble_quality, "DATASET", small)
    text = ensemble_quality.report(config=replace(TINY, updates=6, validate_every=3))
    assert [row[0] for row in cells(text)[1:]] == ["fatigue", "consumption"]
    assert "Reference quality not reached; the whole fit took" in text
