"""The GPU's check, tried on a processor: its rows, its time, its verdicts."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks import gpu_check, gpu_paths, gpu_rates, run
from benchmarks.gpu_paths import FAILED
from benchmarks.records import Results, Row
from benchmarks.settings import Settings
from components.algorithms import ALGORITHMS
from components.training.cuda_graphs import GraphedLearner

SETTINGS = Settings(quick=True, threads=1, seconds=0.01, repetitions=2)


@pytest.mark.slow(20)
def test_checks_and_rates_run_on_a_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_paths, "_names", lambda settings: ["td3_bc", "mopo"])
    for check in (gpu_paths.draws, gpu_paths.twins, gpu_paths.captures):
        found = [(row.name, row.note) for row in check(SETTINGS)]
        assert found == [("td3_bc", "ok"), ("mopo", "ok")]
    rate, *kernels = gpu_rates.rates("td3_bc", SETTINGS)
    assert rate.name == "td3_bc, 1 lane(s)"
    assert rate.value > 0.0
    assert kernels[0].name == "all"
    assert {row.measure for row in kernels[1:]} == {"%"}
    assert sum(row.value for row in kernels[1:]) <= 100.0


def test_what_goes_another_way_or_loses_its_graph_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_paths, "_names", lambda settings: ["ddpg"])

    def refused(backend: object, run: object) -> None:
        raise RuntimeError("no room")

    monkeypatch.setattr(gpu_paths.RecordedGraphs, "capture", refused)
    with pytest.warns(UserWarning, match="No CUDA graph"):
        [row] = gpu_paths.captures(SETTINGS)
    several = ALGORITHMS["ddpg"].learner.updates_per_graph
    assert row.note.startswith(f"{FAILED}{several} updates at once: no room")
    monkeypatch.setattr(GraphedLearner, "run_updates", lambda made, first, count, sums: None)
    [row] = gpu_paths.twins(SETTINGS)
    assert row.note == f"{FAILED}further than 5%"
    assert row.value == pytest.approx(1.0), "it has stayed where it was"


def test_targets_are_judged() -> None:
    assert gpu_rates._judged("cql", 80, 101.0) == "101.0 updates/s; target 100.0 met"
    assert gpu_rates._judged("cql", 80, 99.0) == "99.0 updates/s; target 100.0 missed"
    assert gpu_rates._judged("cql", 5, 99.0) == "99.0 updates/s"


def check(monkeypatch: pytest.MonkeyPatch, folder: Path, *words: str) -> Results:
    command = ["gpu_check", "--device", "cpu", "--quick", "--results", str(folder), *words]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as ended:
        gpu_check.main()
    [stored] = folder.glob("*-gpu-check.json")
    results = Results.read(stored)
    bad = any(row.note.startswith((FAILED, "failed")) for row in results.rows)
    assert ended.value.code == int(bad)
    return results


@pytest.mark.parametrize("note", ["ok", f"{FAILED}td3_bc", "failed with exit code 1: no"])
def test_a_failed_check_is_the_exit_code(
    note: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured(name: str, settings: Settings, longest: float, module: str) -> list[Row]:
        assert module == "benchmarks.gpu_check"
        assert longest <= 120.0
        return [Row(unit=name, name=name, note=note)]

    monkeypatch.setattr(run, "measured", measured)
    found = check(monkeypatch, tmp_path, "--only", "draws", "twins")
    assert found.finished == ["draws", "twins"]
    assert [row.note for row in found.rows] == [note] * 2


def test_what_no_time_is_left_for_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ticking: Iterator[int] = iter(range(0, 100_000, 30))
    monkeypatch.setattr(gpu_check.time, "monotonic", lambda: float(next(ticking)))
    fine = [Row(unit="check", name="check", note="ok")]
    monkeypatch.setattr(run, "measured", lambda *words, module: fine)
    found = check(monkeypatch, tmp_path, "--minutes", "2", "--only", "draws", "twins", "captures")
    assert [row.note for row in found.rows][-1] == "left out: no time was left"
    assert found.rows[0].note == "ok"


def test_without_a_gpu_the_way_to_try_it_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["gpu_check"])
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(SystemExit):
        gpu_check.main()
    assert "--device cpu --quick" in capsys.readouterr().err
