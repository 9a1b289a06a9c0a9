"""Tensors on disk: whole or not at all, never unpickled."""

import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from components.core.integrity import DamagedFileError
from components.core.tensors import load_tensors, save_tensors

TENSORS = {
    "weight": torch.arange(6.0).view(2, 3),
    "turned": torch.arange(6.0).view(2, 3).T,
    "count": torch.tensor([3, 4]),
    "one": torch.tensor(5.0).expand(1),
    "none": torch.zeros(0, 2),
    "true": torch.tensor([True, False]),
    "loss": torch.tensor([float("inf"), float("nan")]),
}


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    path = tmp_path / "state.safetensors"
    save_tensors(path, TENSORS, {"done": 3, "members": ["a", "b"]})
    return path


def test_round_trip(stored: Path) -> None:
    tensors, header = load_tensors(stored)
    assert header == {"done": 3, "members": ["a", "b"]}
    assert tensors.keys() == TENSORS.keys()
    for name, tensor in TENSORS.items():
        assert tensors[name].dtype == tensor.dtype
        assert torch.equal(torch.nan_to_num(tensors[name]), torch.nan_to_num(tensor))


def test_nothing_but_the_file_is_left(stored: Path) -> None:
    save_tensors(stored, {"other": torch.zeros(1)}, {})
    assert [p.name for p in stored.parent.iterdir()] == [stored.name]
    assert load_tensors(stored)[0].keys() == {"other"}


def test_permissions_are_those_of_an_ordinary_file(stored: Path) -> None:
    other = stored.with_name("other")
    other.touch()
    assert stored.stat().st_mode == other.stat().st_mode


def test_a_failed_write_leaves_the_old_file(stored: Path) -> None:
    before = stored.read_bytes()
    with pytest.raises(TypeError):
        save_tensors(stored, TENSORS, {"not json": object()})
    assert stored.read_bytes() == before
    assert [p.name for p in stored.parent.iterdir()] == [stored.name]


@pytest.mark.parametrize("damage", ["truncated", "cut in the header", "garbled", "empty", "text"])
def test_damaged_files_are_named(stored: Path, damage: str) -> None:
    whole = stored.read_bytes()
    stored.write_bytes(
        {
            "truncated": whole[:-5],
            "cut in the header": whole[:20],
            "garbled": bytes(255 - byte for byte in whole),
            "empty": b"",
            "text": b"these are not the tensors you are looking for",
        }[damage]
    )
    with pytest.raises(ValueError, match=r"state\.safetensors is damaged"):
        load_tensors(stored)


def test_no_byte_can_change_unseen(stored: Path) -> None:
    whole, (expected, header) = stored.read_bytes(), load_tensors(stored)
    length = int.from_bytes(whole[:8], "little")
    blank = {8 + length - 1 - n for n in range(length) if whole[8 + length - 1 - n :][:1] == b" "}
    for position in range(len(whole)):
        changed = bytearray(whole)
        changed[position] ^= 1
        stored.write_bytes(changed)
        try:
            tensors, found = load_tensors(stored)
        except DamagedFileError as error:
            assert error.path == stored  # noqa: PT017 - most positions raise, some are blanks
            continue
        assert position in blank
        assert found == header
        assert tensors.keys() == expected.keys()


def test_files_of_older_versions_have_no_digest_and_are_read(tmp_path: Path) -> None:
    path = tmp_path / "old.safetensors"
    save_file({"x": torch.ones(2)}, path, metadata={"header": '{"done": 3}'})
    tensors, header = load_tensors(path)
    assert tensors["x"].tolist() == [1.0, 1.0]
    assert header == {"done": 3}


def test_a_tensor_that_is_not_there_is_named_with_its_file(stored: Path) -> None:
    with pytest.raises(DamagedFileError, match=r"state\.safetensors lacks 'bias'"):
        load_tensors(stored)[0]["bias"]


def test_equal_tensors_make_equal_files(stored: Path, tmp_path: Path) -> None:
    save_tensors(tmp_path / "again", TENSORS, {"done": 3, "members": ["a", "b"]})
    assert (tmp_path / "again").read_bytes() == stored.read_bytes()


def test_safetensors_of_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "foreign.safetensors"
    save_file({"x": torch.zeros(2)}, path)
    with pytest.raises(ValueError, match=r"foreign\.safetensors .* not written by this project"):
        load_tensors(path)


class Trap:
    """Leaves a mark when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple:
        return Path.touch, (self.mark,)


def test_a_pickle_is_refused_and_never_loaded(tmp_path: Path) -> None:
    path, mark = tmp_path / "state.safetensors", tmp_path / "mark"
    for content in (pickle.dumps(Trap(mark)), pickle.dumps({"weight": [1.0]})):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="is damaged"):
            load_tensors(path)
    torch.save({"trap": Trap(mark)}, path)
    with pytest.raises(ValueError, match="is damaged"):
        load_tensors(path)
    assert not mark.exists()
    pickle.loads(pickle.dumps(Trap(mark)))
    assert mark.exists(), "the trap itself must work"


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nothing does not exist"):
        load_tensors(tmp_path / "nothing")
