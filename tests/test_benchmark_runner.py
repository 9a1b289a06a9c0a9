"""The runner of all benchmarks: rows, files, failures; the JAX peer computes what ours does."""

import ast
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import lanes, learner_paths, plain_peers, run
from benchmarks.floors import Limits, Work, operations, work_of_updates
from benchmarks.model_free import PEER
from benchmarks.records import Results, Row, row_of_seconds
from benchmarks.settings import Settings
from components.core.random_streams import BLOCK
from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate
from components.models import MODELS


@pytest.fixture(scope="module")
def log() -> OfflineDataset:
    return generate(IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=2), seed=0)


def test_a_row_relates_its_median_to_its_floor() -> None:
    rate = row_of_seconds(
        "u", "n", [4.0, 2.0, 1.0], amount=6.0, measure="steps/s", floor=0.5, bound="b"
    )
    assert (rate.value, rate.floor, rate.above) == (3.0, 12.0, 4.0)
    assert (rate.repeats, rate.spread) == (3, 1.5)
    time = row_of_seconds("u", "n", [0.02], measure="ms", floor=0.005, bound="b")
    assert (time.value, time.floor, time.above) == (20.0, 5.0, 4.0)


def test_results_come_back_from_json_and_the_table_says_how_many_times_as_fast_ours_is(
    tmp_path: Path,
) -> None:
    rows = [
        row_of_seconds("u", "five", [2.0, 2.0], amount=10.0, measure="steps/s"),
        row_of_seconds("u", "five", [4.0], amount=10.0, measure="steps/s", peer="other 1"),
        row_of_seconds("u", "one", [2.0]),
        row_of_seconds("u", "one", [1.0], peer="other 1"),
        Row(unit="v", name="broken", note="failed with exit code 1"),
    ]
    results = Results({"device": "cpu"}, rows, ["a", "b"])
    results.write(tmp_path / "deep" / "found.json")
    assert Results.read(tmp_path / "deep" / "found.json") == results
    lines = (tmp_path / "deep" / "found.md").read_text(encoding="utf-8").splitlines()
    assert "- device: cpu" in lines
    table = [[cell.strip() for cell in line.split("|")] for line in lines if line.startswith("| ")]
    programs = [row[2] for row in table]
    assert programs == ["program", "ours", "other 1", "ours", "other 1", "program", "ours"]
    assert table[0][7] == "ours is"
    assert [row[7] for row in table[1:5]] == ["", "2.00", "", "0.50"]
    assert table[-1][3:5] == ["failed with exit code 1", "-"]


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text("[1]")
    with pytest.raises(ValueError, match=r"other\.json holds no results of benchmarks\.run"):
        Results.read(tmp_path / "other.json")


def test_floors_count_products_and_what_an_update_changes(log: OfflineDataset) -> None:
    left, right = torch.ones(3, 4), torch.ones(4, 5)
    assert operations(lambda: left @ right) == 2 * 3 * 4 * 5
    assert Work(100.0, 10.0).floor(Limits(10.0, 100.0), 2) == (20.0, "matrix products")
    assert Work(100.0, 10.0).floor(Limits(1000.0, 1.0)) == (10.0, "memory")
    settings = {"hidden": (8,), "batch": 16}
    learner = lanes.program("td3_bc", log, [0], torch.device("cpu"), **settings)
    learner.update(0), learner.update(1)  # Adam's moments exist from now on
    work = work_of_updates(learner, (2, 3))
    critic, actor = 184 * 8 + 8 + 8 + 1 - 8, 180 * 8 + 8 + 8 * 3 + 3  # numbers of a network
    # twins with two moments at every update; actor with moments and all targets at every second
    changed = 2 * critic * 3 + (actor * 3 + 2 * critic + actor) / 2
    assert work.traffic / 8 == pytest.approx(changed, rel=0.02)  # and Adam's counters
    assert work.operations > 0


def test_a_slow_learner_pays_its_share_of_a_block_s_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    now, pace = 0.0, 1.0

    def once(self: Settings, run: Callable[[], object]) -> float:
        before = now
        run()
        return now - before

    def update(step: int) -> None:
        nonlocal now
        now += pace * (1.0 + (2.5 if step % BLOCK == 0 else 0.0))

    monkeypatch.setattr(Settings, "once", once)
    settings = Settings(seconds=6.0, repetitions=3)
    slow = learner_paths.seconds_per_update(update, 100, settings)
    assert slow == pytest.approx([1.0 + 2.5 / BLOCK] * 3)  # draws of a block take 2.5 s
    fast = learner_paths.seconds_per_update(update, 100, Settings(seconds=300.0, repetitions=3))
    assert fast == pytest.approx([1.0 + 2.5 / BLOCK] * 3)
    pace = 10.0  # few repeats of what is very slow
    assert learner_paths.seconds_per_update(update, 100, settings) == pytest.approx(
        [10.0 + 25.0 / BLOCK] * 2
    )


@pytest.mark.slow(6)
def test_evaluation_is_measured() -> None:
    settings = Settings(quick=True, threads=1, seconds=0.01, matrix_rate=1e9, bandwidth=1e9)
    ours, peer = run.measured("evaluation", settings)
    assert ours.note == "actor 256-256"
    assert ours.value
    assert peer.value
    assert peer.peer


@pytest.mark.slow(15)
def test_a_quick_run_stores_two_benchmarks_and_a_missing_peer_and_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["run", "--quick", "--threads", "1", "--results", str(tmp_path)]
    words += ["--peer", str(tmp_path / "python")]
    monkeypatch.setattr(sys, "argv", [*words, "--only", "industrial", "td3_bc-jax"])
    run.main()
    [stored] = tmp_path.glob("*.json")
    assert stored.with_suffix(".md").is_file()
    monkeypatch.setattr(
        sys, "argv", [*words, "--only", "industrial", "dataset", "--resume", str(stored)]
    )
    run.main()
    assert [*tmp_path.glob("*.json")] == [stored]
    results = Results.read(stored)
    assert results.finished == ["industrial", "td3_bc-jax", "dataset"]
    ours = [row for row in results.rows if not row.note and not row.peer]
    assert [row.name for row in ours][:2] == ["1 copies", "100 copies"]
    assert all(row.value and row.value > 0 and row.repeats == 2 for row in ours)
    assert "left out: `make peers` installs its peer" in [row.note for row in results.rows]
    assert {"date", "processor", "versions", "matrix products"} <= results.computer.keys()
    text = stored.read_text() + stored.with_suffix(".md").read_text()
    assert str(tmp_path) not in text
    assert str(Path.cwd()) not in text
    assert "## Industrial Benchmark" in capsys.readouterr().out


@pytest.mark.slow(8)
def test_a_benchmark_that_fails_or_hangs_is_a_row_that_says_so() -> None:
    settings = Settings(quick=True, threads=1, device="nowhere", seconds=0.01)
    [row] = run.measured("evaluation", settings)
    assert row.value is None
    assert row.note.startswith("failed with exit code 1: RuntimeError")
    [row] = run.measured("evaluation", settings, longest=0.01)
    assert row.note == "stopped after 0 s"


def test_a_run_that_was_stopped_goes_on_with_the_same_code_and_computer_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def measured(name: str, settings: Settings, longest: float) -> list[Row]:
        asked.append(name)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return [Row(unit=name, name=name, note="made up")]

    def start(*words: str) -> None:
        command = ["run", "--quick", "--threads", "1", "--results", str(tmp_path), *words]
        monkeypatch.setattr(sys, "argv", command)
        run.main()

    monkeypatch.setattr(run, "measured", measured)
    with pytest.raises(SystemExit) as ended:
        start("--only", "industrial", "robots", "dataset")
    assert ended.value.code == 130
    [stored] = tmp_path.glob("*.json")
    assert f"--resume {stored} goes on" in capsys.readouterr().err
    monkeypatch.setattr(run, "_commit", lambda: "another")
    with pytest.raises(SystemExit) as ended:
        start("--resume", str(stored))
    assert ended.value.code == 2
    assert "was begun with commit " in capsys.readouterr().err
    monkeypatch.undo()
    monkeypatch.setattr(run, "measured", measured)
    start("--only", "industrial", "robots", "dataset", "--resume", str(stored))
    assert asked == ["industrial", "robots", "robots", "dataset"]
    assert Results.read(stored).finished == ["industrial", "robots", "dataset"]


@pytest.mark.slow(8)
def test_learners_side_by_side_say_what_a_core_is_worth() -> None:
    settings = Settings(quick=True, threads=2, seconds=0.01, matrix_rate=1e9, bandwidth=1e9)
    [row] = run.measured("together", settings)
    assert row.name == "bc, 1 lane(s), 2 processes of one thread"
    assert row.rate is not None
    assert (row.rate["processes"], row.rate["threads"], row.rate["kind"]) == (2, 1, "bc")
    assert row.rate["seconds"] > 0.0


def test_peers_that_loop_do_the_work_that_ours_does(log: OfflineDataset) -> None:
    config = MODELS["behaviour_policy"].config(epochs=1)
    plain_peers.clone_epoch(log, config)()
    card = log.card
    loop = plain_peers.evaluation_loop(
        card.environment, dict(card.environment_parameters), (8,), horizon=3
    )
    assert loop() < 0.0  # rewards of the Industrial Benchmark are costs


def _jax() -> Path:
    look = "import importlib.util, sys; sys.exit(importlib.util.find_spec('optax') is None)"
    if not PEER.is_file() or subprocess.run([PEER, "-I", "-c", look], check=False).returncode:
        pytest.skip("no JAX in .venv-peers; `make peers` installs it")
    return PEER


@pytest.mark.slow(20)
@pytest.mark.parametrize("algorithm", learner_paths.IN_JAX)
def test_the_jax_peer_computes_our_update(
    algorithm: str, log: OfflineDataset, tmp_path: Path
) -> None:
    python = _jax()
    settings = {"hidden": (8, 6), "batch": 16, "target_rate": 0.1, "learning_rate": 1e-3}
    if algorithm == "cql":
        settings |= {"cloning": 0.0, "tried_actions": 4, "actor_learning_rate": 2e-3}
    learner = lanes.program(algorithm, log, [0, 1], torch.device("cpu"), **settings)

    def networks() -> dict[str, np.ndarray]:
        found = {}
        for name in ("actor", "critics", "critics_target"):
            network = learner._networks[name]
            stack = getattr(network, "stack", network)
            for i, (weight, bias) in enumerate(stack.affine()):
                shape = (2,) if name == "actor" else (2, 2)
                found[f"{name}/{i}/weight"] = (
                    weight.detach().numpy().reshape(*shape, *weight.shape[1:])
                )
                found[f"{name}/{i}/bias"] = bias.detach().numpy().reshape(*shape, bias.shape[-1])
        return {name: array.copy() for name, array in found.items()}

    given = networks()
    for number in range(2):  # TD3+BC's second update is the one with the actor
        drawn = {name: tensor.clone() for name, tensor in learner._streams.at(number).items()}
        batch = learner._data.batch(drawn.pop("row"))
        given |= {f"batch/{number}/{name}": part.numpy() for name, part in vars(batch).items()}
        given |= {f"draw/{number}/{name}": tensor.numpy() for name, tensor in drawn.items()}
        learner.update(number)
    np.savez(tmp_path / "given.npz", **given)
    wanted = {"algorithm": algorithm, **asdict(learner._config)}
    script = Path(lanes.__file__).with_name("peer_jax.py")
    words = [str(tmp_path / "given.npz"), json.dumps(wanted), "--check", str(tmp_path / "f.npz")]
    subprocess.run([python, "-I", script, *words], check=True)
    ours = networks()
    with np.load(tmp_path / "f.npz") as found:
        assert set(found.files) == set(ours)
        for name, array in ours.items():
            # two Adam steps of 1e-3: the gradients' float32 sums are in another order
            np.testing.assert_allclose(found[name], array, rtol=1e-3, atol=2e-5, err_msg=name)
            assert not np.array_equal(array, given[name.replace("_target", "")])


def test_the_jax_script_needs_nothing_of_this_project() -> None:
    script = Path(lanes.__file__).with_name("peer_jax.py")
    tree = ast.parse(script.read_text(encoding="utf-8"))
    names = [n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    names += [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
    foreign = {name.split(".")[0] for name in names} - sys.stdlib_module_names
    assert foreign == {"jax", "numpy", "optax"}
