"""The door that makes datasets: exports for Minari that are safe to repeat, and dry runs."""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.minari_exchange import import_minari
from components.data.sources.source import generate
from flows import generate_data
from flows.command_line import main

WORDS = ["profile=smoke", "data.trajectories=2", "data.steps=40", "runner.executor=serial"]


def door(monkeypatch: pytest.MonkeyPatch, store: Path, *words: str) -> int:
    """The exit code of the command."""
    command = ["generate_data", *WORDS, "runner.tracker=none", f"store={store}", *words]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as ended:
        main("generate_data", generate_data.HELP, generate_data._run)
    return int(ended.value.code or 0)


@pytest.mark.slow(4)
def test_another_seed_replaces_the_exports_and_the_former_one_brings_them_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    minari, digests = tmp_path / "minari", []
    for words in (
        ("datasets=[mediocre-0.2]",),
        ("datasets=[mediocre-0.2,bad-0.4]", "data.seed=1"),
        ("datasets=[mediocre-0.2]",),
    ):
        assert door(monkeypatch, tmp_path, *words) == 0
        digests.append(import_minari("proximity/mediocre-0p2-v0", minari).card.digest)
    assert digests[0] == digests[2] != digests[1]
    assert import_minari("proximity/bad-0p4-v0", minari).card.seed == 1
    assert capsys.readouterr().out.count("proximity/") == 4
    assert [path.name for path in minari.iterdir()] == ["proximity"]


def test_exports_at_once_wait_for_each_other(tmp_path: Path) -> None:
    logs: list[OfflineDataset] = [
        generate(IndustrialSpec(name, "bad", 0.4, trajectories=2, steps=40), 0)
        for name in ("bad-0.4", "other", "bad-0.4", "third")
    ]
    with ThreadPoolExecutor(4) as pool:
        names = list(pool.map(generate_data._export, logs, [tmp_path / "minari"] * 4))
    for log, name in zip(logs, names, strict=True):
        assert import_minari(name, tmp_path / "minari").card == log.card
    assert [path.name for path in (tmp_path / "minari").iterdir()] == ["proximity"]


@pytest.mark.slow(2)
def test_a_dry_run_leaves_the_disk_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert door(monkeypatch, tmp_path / "store", "dry_run=true") == 0
    assert list(tmp_path.iterdir()) == []
    assert door(monkeypatch, tmp_path / "store") == 0
    before = sorted(tmp_path.rglob("*"))
    assert door(monkeypatch, tmp_path / "store", "data.seed=1", "dry_run=true") == 0
    assert sorted(tmp_path.rglob("*")) == before
