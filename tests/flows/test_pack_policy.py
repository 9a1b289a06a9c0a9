"""Packing a stored policy: the folder is whole, opens without its store, and is not overwritten."""

import sys
from pathlib import Path

import pytest

from components.operating.operable import Operable
from components.operating.session import Session
from flows.door import run_door
from flows.pack_policy import HELP, load_pack_settings, pack
from tests.flows.console.stores import BROKEN, HOSTILE, LOG_KEY, hostile_store


def door(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["pack_policy", *words])
    with pytest.raises(SystemExit) as ended:
        run_door("pack_policy", HELP, load_pack_settings, pack)
    return int(ended.value.code or 0)


def test_a_packed_policy_is_operated_without_its_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    store = hostile_store(tmp_path / "runs")
    words = [f"run={HOSTILE}", f"to={tmp_path / 'packed'}", f"store={store.root}"]
    assert door(monkeypatch, *words) == 0
    packed = Operable.load(tmp_path / "packed")
    assert packed.log is None
    assert Session(packed).step().strangeness >= 0
    assert {path.suffix for path in (tmp_path / "packed").rglob("*") if path.is_file()} == {
        ".json",
        ".safetensors",
    }
    assert door(monkeypatch, *words) == 2
    assert (
        "is there already; name another folder, or add overwrite=true." in capsys.readouterr().err
    )
    assert door(monkeypatch, *words, "overwrite=true") == 0
    assert Operable.load(tmp_path / "packed").digest == packed.digest


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["to=x"], 2, "run= is missing; write run=ID to=FOLDER."),
        (["run=x"], 2, "to= is missing"),
        ([f"run={LOG_KEY}", "to=x"], 2, "is not a policy but a run of data_generation"),
        ([f"run={BROKEN}", "to=x"], 1, "is not JSON"),
        (["run=nothing", "to=x"], 2, "holds no such finished run"),
    ],
)
def test_refusals_leave_nothing_behind(
    words: list[str],
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    store = hostile_store(tmp_path / "runs")
    monkeypatch.chdir(tmp_path)
    assert door(monkeypatch, *words, f"store={store.root}") == code
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_folder_of_somebody_elses_is_never_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = hostile_store(tmp_path / "runs")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("four years")
    words = [f"run={HOSTILE}", f"to={tmp_path / 'mine'}", f"store={store.root}"]
    assert door(monkeypatch, *words, "overwrite=true") == 2
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "four years"
