"""Reads the files of conf/."""

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


def _shown(path: Path) -> Path:
    """How messages name a file."""
    return path.relative_to(CONF.parent) if path.is_relative_to(CONF.parent) else path


def read_file(path: Path) -> DictConfig:
    """A file of keys and values.

    Raises:
        SettingsError: It cannot be read, or holds something else.
    """
    shown = _shown(path)
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
    """The content of a folder's files by name; the one key of a file is its own name.

    Raises:
        SettingsError: A file cannot be read, or its key is not its name. A copy with the key of the
            original would otherwise silently replace it.
    """
    found = {}
    for name in names_in(folder):
        path = folder / f"{name}.yaml"
        content = read_file(path)
        if [str(key) for key in content] != [name]:
            holds = ", ".join(repr(str(key)) for key in content) or "nothing"
            raise SettingsError(
                f"{_shown(path)} must hold one key, its own name {name!r}, but holds {holds}; "
                "rename the file or the key, or remove the file."
            )
        [found[name]] = content.values()
    return found
