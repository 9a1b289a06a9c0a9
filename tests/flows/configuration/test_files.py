"""Files of conf/: the one key of each is its own name; other files beside them do no harm."""

import tomllib
from pathlib import Path

import pytest

from flows.configuration.checking import SettingsError
from flows.configuration.files import CONF, foreign_in, names_in, read_file, read_folder

BAD = "bad-0.4:\n  controller: bad\n  epsilon: 0.4\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "dataset"
    made.mkdir()
    (made / "bad-0.4.yaml").write_text(BAD, encoding="utf-8")
    return made


def test_a_folder_is_read_by_name(folder: Path) -> None:
    (folder / "1.0.yaml").write_text("1.0:\n  controller: mediocre\n", encoding="utf-8")
    read = read_folder(folder).content
    assert list(read) == ["1.0", "bad-0.4"]
    assert read["bad-0.4"].epsilon == 0.4
    assert set(read_folder(CONF / "dataset").content) == set(names_in(CONF / "dataset"))


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
def test_a_copy_or_a_broken_file_is_named_in_one_sentence_and_the_others_are_read(
    folder: Path, name: str, content: str, says: str
) -> None:
    (folder / f"{name}.yaml").write_text(content, encoding="utf-8")
    read = read_folder(folder)
    assert read.content == {"bad-0.4": {"controller": "bad", "epsilon": 0.4}}
    assert list(read.broken) == [name]
    assert says in str(read.broken[name])
    assert "\n" not in str(read.broken[name])


def test_binary_files_are_refused_and_hidden_files_named(folder: Path) -> None:
    (folder / "._bad-0.4.yaml").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        ")
    (folder / "mine.yml").write_text("mine: {}\n", encoding="utf-8")
    (folder / ".DS_Store").write_bytes(b"\0")
    assert list(read_folder(folder).content) == ["bad-0.4"]
    hidden, other = foreign_in(folder)
    assert hidden.endswith("dataset/._bad-0.4.yaml is hidden and not read.")
    assert other.endswith("dataset/mine.yml is not read; a file of settings ends in .yaml.")
    (folder / "mine.yaml").write_bytes(b"mine: \xff\xfe")
    with pytest.raises(SettingsError, match=r"dataset/mine\.yaml "):
        read_file(folder / "mine.yaml")


def test_a_missing_conf_is_called_missing(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"profile is missing or empty; .* install it again"):
        names_in(tmp_path / "profile")


def test_all_that_is_read_at_run_time_is_packaged() -> None:
    root = CONF.parent
    setuptools = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "setuptools"
    ]
    packaged = {
        file
        for package, patterns in setuptools["package-data"].items()
        for pattern in patterns
        for file in root.joinpath(*package.split(".")).glob(pattern)
    }
    found = setuptools["packages"]["find"]["include"]
    assert {package for package in setuptools["package-data"] if package[:4] == "conf"} <= {*found}
    rooms = [root / "components", root / "flows", *(CONF / g for g in ("dataset", "domain"))]
    for room in (*rooms, CONF / "profile"):
        files = {
            file for file in room.rglob("*") if file.is_file() and "__pycache__" not in str(file)
        }
        assert {file for file in files if file.suffix not in (".py", ".pyc")} <= packaged
    assert CONF / "config.yaml" in packaged
