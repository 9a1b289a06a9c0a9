"""Packing a stored policy: the folder is whole, opens without its store, and is not overwritten."""

import sys
from pathlib import Path

import pytest

from components.operating.operable import Operable, is_packed, newest, packed_folders
from components.operating.session import Session
from components.policies.policy import Policy
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
        (["run=x", "to=x", "to=x"], 2, "to is given twice; give it once."),
        (["run=x", "to=x", "overwrite"], 2, "'overwrite' has no value; write overwrite=true."),
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


@pytest.mark.parametrize("beside", ["nothing", "a policy", "a packed policy"])
def test_a_folder_of_somebody_elses_is_never_overwritten(
    beside: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    store, mine = hostile_store(tmp_path / "runs"), tmp_path / "mine"
    words = [f"run={HOSTILE}", f"to={mine}", f"store={store.root}"]
    if beside == "a packed policy":
        assert door(monkeypatch, *words) == 0
    mine.mkdir(exist_ok=True)
    if beside == "a policy":
        newest(Policy.load(store.path(HOSTILE) / "policy")).save(mine)
    (mine / "thesis.txt").write_text("four years")
    capsys.readouterr()
    assert door(monkeypatch, *words, "overwrite=true") == 2
    assert "is there and is no packed policy; name another folder." in capsys.readouterr().err
    assert (mine / "thesis.txt").read_text() == "four years"


def test_an_artifact_of_a_store_is_no_packed_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = hostile_store(tmp_path / "runs")
    artifact = store.path(HOSTILE) / "policy"
    words = [f"run={HOSTILE}", f"to={artifact}", f"store={store.root}"]
    assert door(monkeypatch, *words, "overwrite=true") == 2
    assert store.complete(HOSTILE)
    Policy.load(artifact)


def test_the_former_folder_stays_until_the_new_one_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    store, packed = hostile_store(tmp_path / "runs"), tmp_path / "packed"
    words = [f"run={HOSTILE}", f"to={packed}", f"store={store.root}", "overwrite=true"]
    assert door(monkeypatch, *words) == 0
    before = {path.name: path.read_bytes() for path in packed.rglob("*") if path.is_file()}

    def full(*_: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr("components.operating.operable.save_tensors", full)
    assert door(monkeypatch, *words) == 1
    assert "No space left on device" in capsys.readouterr().err
    assert {p.name: p.read_bytes() for p in packed.rglob("*") if p.is_file()} == before
    assert {path.name for path in tmp_path.iterdir()} == {"runs", "packed"}


def test_a_link_to_a_packed_policy_stays_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = hostile_store(tmp_path / "runs")
    words = [f"run={HOSTILE}", f"store={store.root}", "overwrite=true"]
    assert door(monkeypatch, *words, f"to={tmp_path / 'packed'}") == 0
    (tmp_path / "link").symlink_to("packed")
    assert door(monkeypatch, *words, f"to={tmp_path / 'link'}") == 0
    assert (tmp_path / "link").is_symlink()
    assert is_packed(tmp_path / "packed")


def test_a_folder_that_is_being_written_is_not_offered(tmp_path: Path) -> None:
    for name in ("turbine", ".turbine-0123"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "log.json").touch()
    assert packed_folders(tmp_path) == {"turbine": tmp_path / "turbine"}
