"""Settings that came later: results from before them keep their identity.

A stored result is known by the digest of its settings, so one more setting would make all stored
results of a component strangers. An *option* counts only where it is taken: at its default it
changes nothing, and is left out of what identifies a result.
"""

from collections.abc import Mapping
from dataclasses import asdict, field, fields
from typing import Any, Final, TypeVar

__all__ = ["identity", "option", "with_options"]

_OPTION: Final = "option"
T = TypeVar("T")


def option(default: T) -> T:
    """A field of a frozen dataclass of settings, with the default at which it changes nothing."""
    declared: T = field(default=default, metadata={_OPTION: True})
    return declared


def identity(config: Any) -> dict[str, Any]:
    """The settings that identify what is made with them: all but the options not taken."""
    whole = asdict(config)
    for entry in fields(config):
        if _OPTION in entry.metadata and whole[entry.name] == entry.default:
            del whole[entry.name]
    return whole


def with_options(kind: type[Any], recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as :func:`identity` recorded them, with the options that were not taken.

    Args:
        kind: The dataclass of the settings.
        recorded: Of any version of it.
    """
    options = {f.name: f.default for f in fields(kind) if _OPTION in f.metadata}
    return options | dict(recorded)
