"""Files of conf/: the one key of each is its own name; other files beside them do no harm."""

from pathlib import Path

import pytest

from flows.configuration.checking import SettingsError
from flows.configuration.files import CONF, names_in, read_file, read_folder

BAD = "bad-0.4:\n  controller: bad\n  epsilon: 0.4\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "dataset"
    made.mkdir()
    (made / "bad-0.4.yaml").write_text(BAD, encoding="utf-8")
    return made


def test_a_folder_is_read_by_name(folder: Path) -> None:
    (folder / "1.0.yaml").write_text("1.0:\n  controller: mediocre\n", encoding="utf-8")
    read = read_folder(folder)
    assert list(read) == ["1.0", "bad-0.4"]
    assert read["bad-0.4"].epsilon == 0.4
    assert set(read_folder(CONF / "dataset")) == set(names_in(CONF / "dataset"))


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("bad-0.4 copy", BAD, "'bad-0.4 copy', but holds 'bad-0.4'; rename"),
        ("bad-0.4 (copy)", BAD, "dataset/bad-0.4 (copy).yaml must hold one key"),
        ("größe", BAD, "its own name 'größe', but holds 'bad-0.4'"),
        ("bad-0.5", BAD.replace("epsilon: 0.4", "epsilon: 0.5"), "'bad-0.5', but holds 'bad-0.4'"),
        ("two", "two:\n  epsilon: 1\nbad-0.4:\n  epsilon: 1\n", "but holds 'two', 'bad-0.4'"),
        ("mine", "", "its own name 'mine', but holds nothing"),
        ("mine", "mine:\n\tcontroller: bad\n", "mine.yaml is no valid YAML in line 2; correct or"),
        ("mine", "mine: ${\n", "dataset/mine.yaml cannot be read"),
        ("mine", "- mine\n", "dataset/mine.yaml must hold keys and values"),
        ("mine", "42\n", "dataset/mine.yaml cannot be read"),
    ],
)
def test_a_copy_or_a_broken_file_is_refused_in_one_sentence(
    folder: Path, name: str, content: str, says: str
) -> None:
    (folder / f"{name}.yaml").write_text(content, encoding="utf-8")
    with pytest.raises(SettingsError) as caught:
        read_folder(folder)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_binary_files_are_refused_and_hidden_files_ignored(
    folder: Path,
) -> None:
    (folder / "._bad-0.4.yaml").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        ")
    assert list(read_folder(folder)) == ["bad-0.4"]
    (folder / "mine.yaml").write_bytes(b"mine: \xff\xfe")
    with pytest.raises(SettingsError, match=r"dataset/mine\.yaml "):
        read_file(folder / "mine.yaml")
