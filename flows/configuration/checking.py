"""Builds checked objects from plain values; what does not fit ends in one sentence.

A schema is a pydantic model, a typed dictionary or a plain dataclass of a component. The same
rules hold for all: no unknown keys, no infinite numbers or numbers beyond those that PyTorch
computes with, no boolean where a number belongs. Folders may begin with `~`.
"""

import difflib
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    ValidationError,
    create_model,
    field_validator,
)
from pydantic_core import ErrorDetails

from flows.configuration.field_types import keys_of
from flows.pipeline.remote.places import copy_of, is_address

__all__ = ["SettingsError", "StoreFolder", "StrictModel", "build_config", "first_line", "hint"]

_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
_NO_GROUP = ("model_type", "dict_type", "dataclass_type")
_NO_LIST = ("tuple_type", "list_type")
_LARGEST_WHOLE: Final = 2**63 - 1
_LARGEST: Final = 3.4e38  # of single precision


class SettingsError(ValueError):
    """Something on the command line or in conf/ is wrong; the message is one sentence."""


class StrictModel(BaseModel):
    """A frozen group of settings that refuses unknown keys and infinite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _from_home(cls, value: Any) -> Any:
        if not isinstance(value, Path):
            return value
        try:
            return value.expanduser()
        except RuntimeError as error:
            raise ValueError(f"there is no such home folder: {value}.") from error


def _store(store: Any) -> Any:
    if store == "":
        raise SettingsError("store= is empty; name a folder, e.g. store=mlruns.")
    if not isinstance(store, str) or not is_address(store):
        return store
    try:
        return copy_of(store)
    except ValueError as error:
        raise SettingsError(str(error)) from error


StoreFolder = Annotated[Path, BeforeValidator(_store)]
"""A store: its folder, or for one that a URL names the folder of its copy on this machine."""


def build_config(kind: Any, path: str, fields: Any, *, exact: bool = False) -> Any:
    """A checked object.

    Args:
        kind: Its schema.
        path: Where the fields come from, for messages; may be empty.
        fields: Values by key.
        exact: Whether every key must be given.

    Raises:
        SettingsError: One sentence that names the key.
    """
    missing = [name for name in keys_of(kind) if isinstance(fields, Mapping) and name not in fields]
    if exact and missing:
        raise SettingsError(f"{path} lacks {', '.join(missing)}.")
    _refuse_odd_values(kind, path, fields)
    try:
        return _holder(kind)(held=fields).held  # type: ignore[attr-defined]
    except ValidationError as error:
        found = error.errors()
        # A misspelt key is missing under its right name, too.
        first = next((e for e in found if e["type"] in _UNKNOWN), found[0])
        raise SettingsError(_sentence(kind, path, first)) from error


@cache
def _holder(kind: Any) -> type[StrictModel]:
    """A model with one field of a schema's type: plain dataclasses are checked by its rules."""
    return create_model("Holder", __base__=StrictModel, held=(kind, ...))


def _refuse_odd_values(kind: Any, where: str, value: Any) -> None:
    """Refuse what pydantic would let pass: booleans as 0 and 1, and numbers beyond all bounds."""
    if isinstance(value, Mapping):
        keys = keys_of(kind)
        for name, part in value.items():
            inner = f"{where}.{name}" if where else str(name)
            if isinstance(part, bool) and keys.get(name, bool) is not bool:
                raise _no_boolean(inner, part)
            _refuse_odd_values(keys.get(name), inner, part)
    elif isinstance(value, list | tuple):
        for part in value:
            if isinstance(part, bool):
                raise _no_boolean(where, part)
            _refuse_odd_values(None, where, part)
    elif isinstance(value, int) and abs(value) > _LARGEST_WHOLE:
        raise SettingsError(f"{where}={value} is too large; the largest number is 2^63 - 1.")
    elif isinstance(value, float) and _LARGEST < abs(value) < float("inf"):
        raise SettingsError(f"{where}={value} is too large; the largest number is {_LARGEST:g}.")


def _no_boolean(where: str, value: bool) -> SettingsError:
    return SettingsError(f"{where}={str(value).lower()}: Input should not be a boolean.")


def _sentence(kind: Any, path: str, error: ErrorDetails) -> str:
    """Pydantic's error as one sentence."""
    cause = error.get("ctx", {}).get("error")
    if isinstance(cause, SettingsError):
        return str(cause)
    _, *steps = error["loc"]
    where = ".".join([*([path] if path else []), *map(str, steps)])
    if error["type"] in _UNKNOWN:
        for step in steps[:-1]:
            kind = keys_of(kind).get(str(step))
        valid = list(keys_of(kind))
        listing = f"valid keys there: {', '.join(valid)}."
        return f"Unknown key {where!r}; {listing}{hint(str(steps[-1]), valid)}"
    if error["type"] in _NO_GROUP:
        return f"{where}={error['input']!r} must be a group of keys, e.g. {where}.KEY=VALUE."
    if error["type"] in _NO_LIST:
        return f"{where}={error['input']} must be a list; write {where}=[{error['input']}]."
    if error["type"] == "missing":
        return f"{where} is missing; give it a value."
    if error["type"] == "value_error":
        reason = error["msg"].removeprefix("Value error, ")
        return f"{where}: {reason}" if where else reason
    return f"{where}={error['input']!r}: {error['msg']}."


def hint(word: str, valid: Iterable[str]) -> str:
    """A further sentence that names the most similar valid word; empty if none is.

    Words that differ in their numbers alone, such as bad-0.4 and bad-0.6, are named together:
    which of them is meant only the person knows.
    """
    by_case = {name.casefold(): name for name in valid}
    close = difflib.get_close_matches(word.casefold(), list(by_case), n=1)
    if not close:
        return ""
    found = by_case[close[0]]
    family = [name for name in by_case.values() if _shape(name) == _shape(found)]
    if len(family) > 1 and word.casefold() != close[0] and _shape(word) == _shape(found):
        return f" Of this kind there are {', '.join(family)}."
    return f" Did you mean {found!r}?"


def _shape(word: str) -> str:
    """A word with all its numbers made equal."""
    return re.sub(r"[\d.]+", "0", word.casefold())


def first_line(error: Exception) -> str:
    """The first line of an error's message."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
