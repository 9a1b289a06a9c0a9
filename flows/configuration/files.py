"""The files of conf/ as they are written."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from flows.configuration.checking import SettingsError, first_line

__all__ = ["CONF", "names_in", "read_file", "read_folder"]

CONF = Path(__file__).resolve().parents[2] / "conf"


def names_in(folder: Path) -> list[str]:
    """The files of a folder, by name; hidden ones belong to other programs."""
    return sorted(path.stem for path in folder.glob("*.yaml") if not path.name.startswith("."))


def read_file(path: Path) -> DictConfig:
    """A file of keys and values.

    Raises:
        SettingsError: It cannot be read, or holds something else.
    """
    shown = f"{path.parent.name}/{path.name}"
    try:
        content = OmegaConf.load(path)
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f" in line {mark.line + 1}" if mark else ""
        raise SettingsError(f"{shown} is no valid YAML{place}; correct or remove it.") from error
    except (OSError, UnicodeDecodeError, OmegaConfBaseException) as error:
        reason = first_line(error).rstrip(".")
        raise SettingsError(f"{shown} cannot be read: {reason}; correct or remove it.") from error
    if not isinstance(content, DictConfig):
        raise SettingsError(f"{shown} must hold keys and values, KEY: VALUE.")
    return content


def read_folder(folder: Path) -> dict[str, Any]:
    """What the files of a folder say, by name: each describes one thing, below its own name.

    Raises:
        SettingsError: A file cannot be read or describes something else, as a copy does. It would
            else win over the original, or be ignored, without a word.
    """
    found = {}
    for name in names_in(folder):
        content = read_file(folder / f"{name}.yaml")
        if [str(key) for key in content] != [name]:
            holds = ", ".join(repr(str(key)) for key in content) or "nothing"
            raise SettingsError(
                f"{folder.name}/{name}.yaml must hold one key, its own name {name!r}, but holds "
                f"{holds}; rename the file or the key, or remove the file."
            )
        [found[name]] = content.values()
    return found
