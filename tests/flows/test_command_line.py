"""What all doors refuse before anything starts: stores, memory, and estimates beyond a year."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from flows import full_benchmark
from flows.command_line import check_store, main
from flows.configuration.checking import SettingsError
from flows.configuration.settings import load_settings
from flows.pipeline.json_lines import read_lines
from flows.pipeline.outcome import STOPPED
from flows.pipeline.schedule import Group
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan
from flows.planning.memory import check_capacity, least_bytes, total_memory
from tests.flows.grid import overridden

BASE = ("profile=smoke", "algorithms=[lion,td3_bc]", "seeds=[0,1]", "dry_run=true")


@pytest.fixture(autouse=True)
def no_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)


def door(words: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["door", *words])
    with pytest.raises(SystemExit) as ended:
        main("door", full_benchmark.HELP, full_benchmark._run)
    return int(ended.value.code or 0)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ["algorithm.td3_bc.batch=9999999999"],
            "td3_bc/mediocre-0.2/seed0 needs at least 1,192 GiB",
        ),
        (
            ["algorithm.lion.hidden=[9999999999]"],
            "lion/mediocre-0.2/seed0 needs at least 55,432 GiB",
        ),
        (["model.recurrent_ensemble.hidden=9999999"], "(members=2, hidden=9999999, horizon=50"),
        (["evaluation.trajectories=1e12"], "(trajectories=1000000000000, horizon=20, 2 at once)"),
        (["data.trajectories=1000000000000"], "data/mediocre-0.2 needs at least 7,450,581 GiB"),
        (["algorithm.lion.updates=1000000000000"], "take 17,470 days; choose less, or add yes"),
        (
            ["algorithm.lion.updates=99999999999999999999"],
            "is too large; the largest number is 2^63",
        ),
        (
            ["data.steps=1"],
            "has 1 steps an episode and never fills an observation of 30",
        ),
        (["algorithms=[rvs]", "data.steps=15", "data.trajectories=9"], "never fills"),
        (
            ["algorithms=[rvs]", "algorithm.rvs.window=300"],
            "algorithm.rvs.window=300, but mediocre",
        ),
        (
            ["algorithm.lion.start_after=200", "algorithm.lion.start_window=201"],
            "algorithm.lion.start_after=200, but mediocre-0.2 has 200 steps",
        ),
        (
            ["datasets=[swimmer]", "algorithms=[bc]", "data.transitions=200"],
            "swimmer: data.transitions=200 may be a single episode of up to 200 steps",
        ),
        (["store=pyproject.toml"], "store=pyproject.toml: pyproject.toml is a file; name a folder"),
        (["store=pyproject.toml/x"], "pyproject.toml is a file; name a folder"),
        ([f"store={'x' * 300}"], "cannot be used: File name too long"),
    ],
)
def test_what_cannot_work_is_said_by_the_dry_run(
    words: list[str],
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert door(overridden(BASE, words), monkeypatch) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert says in line
    assert line.endswith(".")


def test_a_sweep_that_cannot_begin_ends_in_the_tracker_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record = tmp_path / "sweeps" / "mine.json"
    record.mkdir(parents=True)
    words = ["profile=smoke", "algorithms=[bc]", "runner.executor=serial", "runner.tracker=file"]
    assert door([*words, f"store={tmp_path}", "sweep=mine"], monkeypatch) == 1
    assert f"move it away: '{record}'" in capsys.readouterr().err
    events = read_lines(tmp_path / "tracking" / "mine.jsonl")
    assert [event["event"] for event in events] == ["open", "close"]
    assert events[-1]["status"] == "FAILED"


@pytest.mark.slow(4)
def test_a_sweep_stops_at_its_limit_and_the_same_command_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["profile=smoke", "algorithms=[bc]", "runner.executor=serial", "runner.tracker=file"]
    words += [f"store={tmp_path}", "sweep=mine"]
    assert door([*words, "max_hours=1e-9"], monkeypatch) == STOPPED
    told = capsys.readouterr().err
    assert "\nIt stops after 1e-09 hours, resumably.\n" in told
    assert "Stopped, since max_hours=1e-09 are over; nothing finished is lost. Continue" in told
    assert read_lines(tmp_path / "tracking" / "mine.jsonl")[-1]["status"] == "KILLED"
    assert door(words, monkeypatch) == 0
    assert read_lines(tmp_path / "tracking" / "mine.jsonl")[-1]["status"] == "FINISHED"


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("until=25:00", "until=25:00 is no time of day; write hours:minutes, e.g. 07:00."),
        ("until=7", "until=7 is no time of day"),
        ("max_hours=0", "runner.max_hours"),
    ],
)
def test_a_limit_that_is_none_is_refused(word: str, says: str) -> None:
    with pytest.raises(SettingsError, match=says):
        load_settings([word])


def test_a_run_of_years_can_be_wanted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*BASE, "algorithm.lion.updates=1000000000000", "yes=true"]
    assert door(words, monkeypatch) == 0
    assert "17,470 days with" in capsys.readouterr().out


def test_the_whole_benchmark_is_not_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["dry_run=true", f"store={tmp_path / 'none'}", "runner.cpus=2"]
    assert door(words, monkeypatch) == 0
    assert " days with 2 at once" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


def test_on_a_cluster_memory_is_not_that_of_this_computer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
    words = ["algorithms=[td3_bc]", "algorithm.td3_bc.batch=9999999999", "yes=true"]
    assert door(overridden(BASE, words), monkeypatch) == 0


def test_a_store_that_may_not_be_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_store(tmp_path / "new" / "store")
    check_store(Path("new"))
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(SettingsError, match=f"store={tmp_path}/a: {tmp_path} may not be written"):
        check_store(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_the_least_memory_counts_weights_batches_and_lanes(tmp_path: Path) -> None:
    words = ["algorithms=[td3_bc]", "algorithm.td3_bc.hidden=[100]", "algorithm.td3_bc.batch=1000"]
    plan = benchmark_plan(load_settings(overridden(BASE, words)))
    policies = [node for node in plan if node.component == "policy_training"]
    weights, batch = (180 * 100 + 100) * 16, 1000 * 100 * 4
    assert least_bytes(policies[:1]) == weights + batch
    assert least_bytes(policies) == 2 * (weights + batch)
    [data] = [node for node in plan if node.component == "data_generation"]
    assert least_bytes([data]) == 10 * 200 * (6 + 3 + 1) * 4
    evaluations = [node for node in plan if node.component == "evaluation"]
    assert least_bytes(evaluations[:1]) == 4 * 2 * 180 * 4  # snapshots, trajectories
    [aggregation] = [node for node in plan if node.component == "aggregation"]
    assert least_bytes([aggregation]) == 0
    group = Group("policies", policies, set())
    check_capacity([group], 2 * (weights + batch), tmp_path)
    with pytest.raises(SettingsError, match=r"needs at least 1\.3 MiB of memory .*, 2 at once\)"):
        check_capacity([group], 2 * (weights + batch) - 1, tmp_path)


def test_the_least_memory_counts_the_critics_of_all_judged_policies(tmp_path: Path) -> None:
    words = ["algorithms=[bc,lion]", "judging.policies=all", "judging.estimates.hidden=[50]"]
    plan = benchmark_plan(load_settings(overridden(BASE, words)))
    judged = [node for node in plan if node.component == "judgement"]
    critic = ((183 * 50 + 50) * 4 + 256 * 50) * 4  # weights in four copies, a batch
    assert least_bytes([n for n in judged if "bc" in n.name]) == 2 * 2 * critic  # seeds, replicas
    needed = 2 * 2 * (1 + 11) * critic  # λ from 0 to 1 in steps of 0.1
    assert least_bytes(judged) == needed
    group = Group("judged", judged, set())
    check_capacity([group], needed, tmp_path)
    said = r"judge/bc/.* \(hidden=\[50\], batch=256, replicas=2, .*4 at once\) .* judge fewer seeds"
    with pytest.raises(SettingsError, match=said):
        check_capacity([group], needed - 1, tmp_path)


def test_a_disk_without_room_for_the_datasets_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = benchmark_plan(load_settings(BASE))
    groups = [Group(n.name, [n], set()) for n in plan if n.component == "data_generation"]
    check_capacity(groups, total_memory("cpu"), ArtifactStore(tmp_path / "s", create=False).root)
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 79_999}))
    with pytest.raises(SettingsError, match=r"takes at least 0\.1 MiB .* free space"):
        check_capacity(groups, total_memory("cpu"), tmp_path / "s")
