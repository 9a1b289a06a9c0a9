"""Files and folders that appear whole or not at all."""

import math
import os
from pathlib import Path

import pytest

from components.core.files import (
    read_json,
    replacing,
    replacing_folder,
    temporary_name,
    without_undefined,
    write_json,
    write_text,
)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_text_and_json_come_back(tmp_path: Path) -> None:
    write_text(tmp_path / "text", "λ\n")
    assert (tmp_path / "text").read_bytes() == "λ\n".encode()
    write_json(tmp_path / "value.json", {"a": [1, None]})
    write_json(tmp_path / "value.json", {"a": [2, None]})
    assert read_json(tmp_path / "value.json") == {"a": [2, None]}
    assert names(tmp_path) == ["text", "value.json"]


def test_a_file_that_is_missing_or_broken_reads_as_none(tmp_path: Path) -> None:
    assert read_json(tmp_path / "missing.json") is None
    for number, content in enumerate((b"", b"{", b"\xff\xfe")):
        (tmp_path / str(number)).write_bytes(content)
        assert read_json(tmp_path / str(number)) is None


def test_what_fails_leaves_the_former_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "value.json"
    write_text(path, "before")

    def fail() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half")
            assert path.read_text() == "before"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "\ud800")
    assert path.read_text() == "before"
    assert names(tmp_path) == ["value.json"]


def test_a_file_does_not_take_the_place_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "value.json").mkdir()
    with pytest.raises(IsADirectoryError, match=r"move it away: '.*/value.json'"):
        write_json(tmp_path / "value.json", 1)
    assert names(tmp_path) == ["value.json"]


def test_a_folder_takes_the_place_of_an_empty_one_but_not_of_a_used_one(tmp_path: Path) -> None:
    def write(content: str) -> None:
        with replacing(tmp_path / "folder") as temporary:
            temporary.mkdir()
            (temporary / "file").write_text(content)

    (tmp_path / "folder").mkdir()
    write("first")
    with pytest.raises(OSError, match="not empty"):
        write("second")
    assert (tmp_path / "folder" / "file").read_text() == "first"
    assert names(tmp_path) == ["folder"]


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is handed to the disk and what is renamed, by name."""
    done: list[str] = []
    rename = os.replace

    def fsync(handle: int) -> None:
        done.append(Path(os.readlink(f"/proc/self/fd/{handle}")).name.partition("-")[0])

    def replace(source: Path, target: Path) -> None:
        done.append(f"-> {target.name}")
        rename(source, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    return done


def test_content_is_on_the_disk_before_it_has_its_name(tmp_path: Path, synced: list[str]) -> None:
    write_json(tmp_path / "value.json", 1, durable=True)
    assert synced == [".value.json", "-> value.json", tmp_path.name.partition("-")[0]]
    synced.clear()
    write_json(tmp_path / "progress.json", 1)
    assert synced == ["-> progress.json"]
    synced.clear()
    with replacing(tmp_path / "folder", durable=True) as temporary:
        (temporary / "deep").mkdir(parents=True)
        (temporary / "deep" / "file").touch()
    assert synced[:4] == ["file", "deep", ".folder", "-> folder"]


def test_temporary_names_are_hidden_neighbours_that_keep_the_suffix(tmp_path: Path) -> None:
    with temporary_name(tmp_path / "walker.mp4") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.name.startswith(".walker.mp4-")
        assert temporary.suffix == ".mp4"
        assert not temporary.exists()
        temporary.mkdir()
        (temporary / "inside").touch()
    assert names(tmp_path) == []


def test_json_has_no_infinite_and_no_undefined_numbers(tmp_path: Path) -> None:
    value = {"a": [1.5, math.inf, (math.nan, "x")], "b": {"c": -math.inf, "d": 2, "e": None}}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", value)
    assert list(tmp_path.iterdir()) == []
    write_json(tmp_path / "a.json", without_undefined(value))
    expected = {"a": [1.5, None, [None, "x"]], "b": {"c": None, "d": 2, "e": None}}
    assert read_json(tmp_path / "a.json") == expected


def test_a_folder_is_replaced_with_all_that_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "packed"
    for content in ("one", "two"):
        with replacing_folder(path) as made:
            made.mkdir()
            (made / content).touch()
            assert not path.exists() or names(path) == ["one"]
    assert names(path) == ["two"]
    assert names(tmp_path) == ["packed"]


def test_a_folder_comes_back_if_the_new_one_cannot_take_its_name(tmp_path: Path) -> None:
    path = tmp_path / "packed"
    path.mkdir()
    (path / "one").touch()
    with pytest.raises(FileNotFoundError), replacing_folder(path):
        pass  # nothing is made
    assert names(path) == ["one"]
    assert names(tmp_path) == ["packed"]
