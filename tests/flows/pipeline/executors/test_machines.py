"""What is said of the machines of a cluster, by real descriptions of this one."""

from pathlib import Path
from typing import Any

import pytest

from flows.pipeline.executors.machines import fault, machine_probe


@pytest.fixture
def token(tmp_path: Path) -> Path:
    (tmp_path / "token").touch()
    return tmp_path / "token"


@pytest.fixture
def ours(token: Path) -> dict[str, Any]:
    return machine_probe()(str(token))


def test_a_machine_like_ours_is_good(ours: dict[str, Any], token: Path) -> None:
    assert (ours["store"], ours["writable"], len(ours["code"])) == (True, True, 64)
    assert fault("m", machine_probe()(str(token)), ours, token.parent) == ""


def test_a_store_that_is_not_there_is_seen(
    ours: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    monkeypatch.setattr("time.monotonic", iter(range(0, 10**6, 6)).__next__)
    elsewhere = machine_probe()(str(tmp_path / "not here" / "token"))
    sentence = fault("m", elsewhere, ours, tmp_path)
    assert sentence == (
        f"m does not see the folder {tmp_path}: choose a store that all machines share."
    )


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"code": ""}, "m does not find this package: install it there"),
        ({"version": "0.0.9"}, "m has proximity-bench 0.0.9, this computer has "),
        ({"python": "3.9"}, "m has Python 3.9, this computer has "),
        ({"torch": "1.0"}, "m has PyTorch 1.0, this computer has "),
        ({"code": "c" * 64}, "m has other code in "),
        ({"writable": False}, "m cannot write into the folder "),
        ({"error": "no module"}, "m cannot run a task (no module): repair it."),
    ],
)
def test_every_difference_has_its_sentence(
    change: dict[str, Any], sentence: str, ours: dict[str, Any], tmp_path: Path
) -> None:
    said = fault("m", ours | change, ours, tmp_path)
    assert said.startswith(sentence)
    assert said.endswith(".")


def test_a_machine_that_does_not_answer(ours: dict[str, Any], tmp_path: Path) -> None:
    assert fault("m", None, ours, tmp_path) == "m does not answer: repair it."


def test_one_changed_source_file_is_another_code(
    ours: dict[str, Any], token: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("flows", "components"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").touch()
    finder = {name: _spec(tmp_path / name) for name in ("flows", "components")}
    monkeypatch.setattr("importlib.util.find_spec", finder.get)
    before = machine_probe()(str(token))
    (tmp_path / "flows" / "__init__.py").write_text("changed = True\n", encoding="utf-8")
    after = machine_probe()(str(token))
    assert len({before["code"], after["code"], ours["code"]}) == 3
    assert after["folder"] == str(tmp_path)


def _spec(folder: Path) -> Any:
    from importlib.machinery import ModuleSpec

    spec = ModuleSpec(folder.name, None, is_package=True)
    spec.submodule_search_locations = [str(folder)]
    return spec
