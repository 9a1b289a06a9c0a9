"""Digests of files: whatever is not as it was written is named, and nothing else is."""

import json
import os
import pickle
from contextlib import suppress
from pathlib import Path

import pytest

from components.core import integrity, sealed
from components.core.files import write_json
from components.core.integrity import (
    SMALL,
    DamagedFileError,
    MissingFileError,
    check_files,
    damaged_path,
    describe_files,
)
from components.core.sealed import (
    RECORD,
    check_folder,
    content_digest,
    is_sealed,
    read_record,
    read_sealed_json,
    seal,
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "artifact"
    (folder / "deep").mkdir(parents=True)
    (folder / "small.json").write_text('{"value": 7}')
    (folder / "deep" / "large.bin").write_bytes(bytes(SMALL + 1))
    seal(folder, {"key": "k", "config": {1: (2.5, None)}})
    return folder


def flip(path: Path, bit: int) -> None:
    """Flip one bit in place."""
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def test_a_manifest_names_every_file_with_size_and_digest(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "b").write_bytes(b"abc")
    (tmp_path / "a").write_bytes(b"")
    described = describe_files(tmp_path)
    assert list(described) == ["a", "deep/b"]
    # FIPS 180-2, appendix B.1, for "abc"
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert described["deep/b"] == {"size": 3, "sha256": digest}
    assert list(describe_files(tmp_path, leave_out=["a"])) == ["deep/b"]
    (tmp_path / "later").touch()
    check_files(tmp_path, described)  # files that nobody described are ignored


@pytest.mark.parametrize("name", ["small.json", "deep/large.bin"])
@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ("flipped", r"is damaged \(its content is not what was written\)"),
        ("truncated", r"is damaged \(it has \d+ bytes, not \d+\)"),
        ("missing", "is missing"),
        ("a folder", r"is damaged \(it has"),
    ],
)
def test_a_damaged_file_is_named(folder: Path, name: str, damage: str, said: str) -> None:
    path = folder / name
    if damage == "flipped":
        flip(path, 60)
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:-1])
    else:
        path.unlink()
        if damage == "a folder":
            path.mkdir()
    with pytest.raises(DamagedFileError, match=f"^{path} {said}") as caught:
        check_folder(folder)
    assert caught.value.path == path
    assert str(caught.value).endswith("; give the command of its sweep again, which makes it anew.")
    other = "deep/large.bin" if name == "small.json" else "small.json"
    check_folder(folder, [other])


def test_no_bit_of_a_record_can_change_unseen(folder: Path) -> None:
    path = folder / RECORD
    written, record = path.read_bytes(), read_record(folder)
    for bit in range(8 * len(written)):
        path.write_bytes(written)
        flip(path, bit)
        with suppress(DamagedFileError):
            assert read_record(folder) == record  # a blank has become another blank


def test_a_record_of_an_older_version_is_accepted_and_half_a_seal_is_not(folder: Path) -> None:
    record = read_record(folder)
    assert is_sealed(record)
    assert content_digest(record) is not None
    old = {name: value for name, value in record.items() if name not in ("files", "digest")}
    write_json(folder / RECORD, old)
    assert check_folder(folder) == old == {"key": "k", "config": {"1": [2.5, None]}}
    assert content_digest(old) is None
    for half in ("files", "digest"):
        write_json(folder / RECORD, old | {half: record[half]})
        with pytest.raises(DamagedFileError, match=rf"{RECORD} is damaged"):
            check_folder(folder)
    for text, said in (("[]", "no JSON object"), ("{", "not JSON")):
        (folder / RECORD).write_text(text)
        with pytest.raises(DamagedFileError, match=said):
            read_record(folder)
    (folder / RECORD).unlink()
    with pytest.raises(MissingFileError, match=rf"{RECORD} is missing"):
        read_record(folder)


def test_a_digit_that_reading_loses_is_damage_too(folder: Path) -> None:
    seal(folder, {"wall_seconds": 0.47371448500001634})
    path = folder / RECORD
    other = path.read_text().replace("0.47371448500001634", "0.47371448500001635")
    assert json.loads(other) == read_record(folder)
    path.write_text(other)
    with pytest.raises(DamagedFileError, match=rf"{RECORD} is damaged \(its content is not"):
        read_record(folder)


def test_equal_files_have_equal_content_whatever_the_record_says(folder: Path) -> None:
    first = content_digest(read_record(folder))
    seal(folder, read_record(folder) | {"finished": 3.0})
    assert content_digest(read_record(folder)) == first
    flip(folder / "small.json", 0)
    seal(folder, read_record(folder))
    assert content_digest(read_record(folder)) != first


def test_json_beside_a_record_is_read_or_named(folder: Path) -> None:
    assert read_sealed_json(folder, "small.json") == {"value": 7}
    write_json(folder / RECORD, {"key": "k"})  # an older version, where nothing can be checked
    (folder / "small.json").write_text('{"value": 8}')
    assert read_sealed_json(folder, "small.json") == {"value": 8}
    (folder / "small.json").write_text("{")
    with pytest.raises(DamagedFileError, match=r"small\.json is damaged \(it is not JSON\)"):
        read_sealed_json(folder, "small.json")
    with pytest.raises(MissingFileError, match=r"other\.json is missing"):
        read_sealed_json(folder, "other.json")


def test_large_files_are_hashed_once_per_process(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(integrity, "_known", {})
    large = folder / "deep" / "large.bin"
    check_folder(folder)
    when = large.stat().st_mtime_ns
    flip(large, 3)
    os.utime(large, ns=(when, when))  # as if the disk had done it
    check_folder(folder)
    with pytest.raises(DamagedFileError):
        check_folder(folder, fresh=True)
    os.utime(large, ns=(when + 1, when + 1))
    check_folder(folder, large=False)
    with pytest.raises(DamagedFileError):
        check_folder(folder)


def test_a_record_is_read_again_when_its_file_is_another_one(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = folder / RECORD
    read, reader = [], sealed.load_json

    def counted(path: Path, remedy: str, *, exact: bool) -> object:
        read.append(path)
        return reader(path, remedy, exact=exact)

    monkeypatch.setattr(sealed, "load_json", counted)
    old = path.stat().st_mtime_ns - 10**10
    first = read_record(folder)
    read_record(folder)
    assert len(read) == 2  # a change right after the last one could have the same time
    os.utime(path, ns=(old, old))
    assert read_record(folder) == read_record(folder) == first
    assert len(read) == 3
    flip(path, 40)
    with pytest.raises(DamagedFileError):
        read_record(folder)
    os.utime(path, ns=(old + 1, old + 1))
    with pytest.raises(DamagedFileError):
        read_record(folder)
    path.unlink()
    with pytest.raises(MissingFileError):
        read_record(folder)


def test_the_error_keeps_its_file_between_processes() -> None:
    for kind in (DamagedFileError, MissingFileError):
        error = kind("a/b is damaged", Path("a/b"), "mend it")
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is kind
        assert str(again) == str(error) == "a/b is damaged; mend it."
        assert damaged_path(again) == Path("a/b")
        assert isinstance(again, ValueError)
    assert isinstance(MissingFileError("a is missing"), FileNotFoundError)
    with pytest.raises(FileNotFoundError) as caught:
        Path("/nowhere/at/all").read_bytes()
    assert damaged_path(caught.value) == Path("/nowhere/at/all")
    assert damaged_path(json.JSONDecodeError("bad", "", 0)) is None
