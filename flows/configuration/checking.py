"""Builds checked objects from plain values; what does not fit ends in one sentence.

A schema is a pydantic model, a typed dictionary or a plain dataclass of a component. The same
rules hold for all: no unknown keys, no infinite numbers, no boolean where a number belongs.
"""

import dataclasses
import difflib
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, create_model
from pydantic_core import ErrorDetails
from typing_extensions import get_type_hints, is_typeddict

__all__ = ["SettingsError", "StrictModel", "build_config", "first_line", "hint"]

_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
_NO_GROUP = ("model_type", "dict_type", "dataclass_type")


class SettingsError(ValueError):
    """Something on the command line or in conf/ is wrong; the message is one sentence."""


class StrictModel(BaseModel):
    """A frozen group of settings that refuses unknown keys and infinite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


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
    missing = [name for name in _keys(kind) if isinstance(fields, Mapping) and name not in fields]
    if exact and missing:
        raise SettingsError(f"{path} lacks {', '.join(missing)}.")
    _refuse_booleans(kind, path, fields)
    try:
        return _holder(kind)(held=fields).held  # type: ignore[attr-defined]
    except ValidationError as error:
        raise SettingsError(_sentence(kind, path, error.errors()[0])) from error


@cache
def _holder(kind: Any) -> type[StrictModel]:
    """A model with one field of a schema's type: plain dataclasses are checked by its rules."""
    return create_model("Holder", __base__=StrictModel, held=(kind, ...))


def _keys(kind: Any) -> dict[str, Any]:
    """The keys of a schema and the types of their values; empty for any other type."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return {field.alias or n: field.annotation for n, field in kind.model_fields.items()}
    if not is_typeddict(kind) and not dataclasses.is_dataclass(kind):
        return {}
    types = get_type_hints(kind)
    if dataclasses.is_dataclass(kind):
        return {field.name: types[field.name] for field in dataclasses.fields(kind)}
    return types


def _refuse_booleans(kind: Any, path: str, fields: Any) -> None:
    """Refuse booleans where numbers belong: pydantic would read them as 0 and 1."""
    keys = _keys(kind)
    for name, value in fields.items() if isinstance(fields, Mapping) else ():
        where = f"{path}.{name}" if path else str(name)
        if isinstance(value, bool) and keys.get(name, bool) is not bool:
            raise SettingsError(f"{where}={str(value).lower()}: Input should not be a boolean.")
        _refuse_booleans(keys.get(name), where, value)


def _sentence(kind: Any, path: str, error: ErrorDetails) -> str:
    """Pydantic's error as one sentence."""
    cause = error.get("ctx", {}).get("error")
    if isinstance(cause, SettingsError):
        return str(cause)
    _, *steps = error["loc"]
    where = ".".join([*([path] if path else []), *map(str, steps)])
    if error["type"] in _UNKNOWN:
        for step in steps[:-1]:
            kind = _keys(kind).get(str(step))
        valid = list(_keys(kind))
        listing = f"valid keys there: {', '.join(valid)}."
        return f"Unknown key {where!r}; {listing}{hint(str(steps[-1]), valid)}"
    if error["type"] in _NO_GROUP:
        return f"{where}={error['input']!r} must be a group of keys, e.g. {where}.KEY=VALUE."
    if error["type"] == "missing":
        return f"{where} is missing; give it a value."
    if error["type"] == "value_error":
        reason = error["msg"].removeprefix("Value error, ")
        return f"{where}: {reason}" if where else reason
    return f"{where}={error['input']!r}: {error['msg']}."


def hint(word: str, valid: Iterable[str]) -> str:
    """A further sentence that names the most similar valid word; empty if none is."""
    close = difflib.get_close_matches(word, list(valid), n=1)
    return f" Did you mean {close[0]!r}?" if close else ""


def first_line(error: Exception) -> str:
    """The first line of an error's message."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
