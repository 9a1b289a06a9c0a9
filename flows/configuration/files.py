"""Reads the files of conf/, and those of a folder of one's own.

A file that is broken, or that is called otherwise than the key it holds, matters to nobody but
those who select it: it is named, and the others keep their meaning.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from flows.configuration.checking import SettingsError, first_line

__all__ = [
    "CONF",
    "HOME",
    "PLANT",
    "ConfFolder",
    "foreign_in",
    "home",
    "names_in",
    "read_datasets",
    "read_file",
    "read_folder",
    "shown",
]

CONF = Path(__file__).resolve().parents[2] / "conf"
HOME: Final = "PROXIMITY_BENCH_HOME"
"""Environment variable that names a folder for logs of one's own, beside the project."""
PLANT: Final = "plant"
"""Domain of logs of plants that are no system of this project."""


@dataclass(frozen=True)
class ConfFolder:
    """The files of a folder of conf/.

    Attributes:
        content: What each holds, by name.
        broken: What is wrong with the others, by name.
    """

    content: dict[str, Any]
    broken: dict[str, SettingsError]


def home() -> Path:
    """Where own logs and their files of settings are: the project, or what `HOME` names.

    Raises:
        SettingsError: That is no folder.
    """
    named = os.environ.get(HOME)
    if not named:
        return CONF.parent
    folder = Path(named).expanduser().absolute()
    if not folder.is_dir():
        raise SettingsError(f"{HOME}={named} is no folder; make it, or name another.")
    return folder


def names_in(folder: Path) -> list[str]:
    """The files of a folder, by name; hidden ones belong to other programs.

    Raises:
        SettingsError: There is none, so conf/ is missing.
    """
    names = sorted(path.stem for path in folder.glob("*.yaml") if not path.name.startswith("."))
    if not names:
        raise SettingsError(
            f"{folder} is missing or empty; the files of conf/ belong to this package: install it "
            "again, or run in a whole copy of the project."
        )
    return names


def foreign_in(folder: Path) -> list[str]:
    """Sentences about the files of a folder that are not read, such as hidden ones and copies."""
    found = sorted(path for path in folder.glob("*") if path.is_file())
    hidden = [path for path in found if path.name.startswith(".") and path.suffix == ".yaml"]
    others = [path for path in found if not path.name.startswith(".") and path.suffix != ".yaml"]
    return [f"{shown(path)} is hidden and not read." for path in hidden] + [
        f"{shown(path)} is not read; a file of settings ends in .yaml." for path in others
    ]


def shown(path: Path) -> Path:
    """How messages name a file, to be pasted: from the current folder on if it is below it."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def read_file(path: Path) -> DictConfig:
    """A file of keys and values.

    Raises:
        SettingsError: It cannot be read, or holds something else.
    """
    named = shown(path)
    try:
        content = OmegaConf.load(path)
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f" in line {mark.line + 1}" if mark else ""
        raise SettingsError(f"{named} is no valid YAML{place}; correct or remove it.") from error
    except (OSError, UnicodeDecodeError, OmegaConfBaseException) as error:
        reason = first_line(error).rstrip(".")
        raise SettingsError(f"{named} cannot be read: {reason}; correct or remove it.") from error
    if not isinstance(content, DictConfig):
        raise SettingsError(f"{named} must hold keys and values, KEY: VALUE.")
    return content


def read_folder(folder: Path) -> ConfFolder:
    """The files of a folder by name; the one key of a file is its own name.

    A copy with the key of the original would otherwise silently replace it.

    Raises:
        SettingsError: The folder is missing.
    """
    content, broken = {}, {}
    for name in names_in(folder):
        try:
            content[name] = _read_own(folder / f"{name}.yaml", name)
        except SettingsError as error:
            broken[name] = error
    return ConfFolder(content, broken)


def read_datasets(project: Path) -> ConfFolder:
    """The files of datasets, the project's and those of `home`.

    Args:
        project: Folder of the project's.

    Raises:
        SettingsError: The project's folder is missing, or both have a file of the same name.
    """
    found, own = read_folder(project), home() / "conf" / "dataset"
    if not os.environ.get(HOME) or own == project or not any(own.glob("*.yaml")):
        return found
    added = read_folder(own)
    names = {*found.content, *found.broken}
    if twice := sorted(names & {*added.content, *added.broken}):
        raise SettingsError(f"{own / twice[0]}.yaml has a name of this project; rename it.")
    content = {name: _below(home(), fields) for name, fields in added.content.items()}
    return ConfFolder(found.content | content, found.broken | added.broken)


def _below(folder: Path, fields: Any) -> Any:
    """Settings of a dataset whose log is named from a folder on."""
    if not isinstance(fields, Mapping) or not isinstance(fields.get("log"), str):
        return fields
    return {**fields, "log": str(folder / Path(fields["log"]).expanduser())}


def _read_own(path: Path, name: str) -> Any:
    """What stands below the one key of a file, its own name."""
    content = read_file(path)
    if [str(key) for key in content] != [name]:
        holds = ", ".join(repr(str(key)) for key in content) or "nothing"
        raise SettingsError(
            f"{shown(path)} must hold one key, its own name {name!r}, but holds {holds}; "
            "rename the file or the key, or remove the file."
        )
    [own] = content.values()
    return own
