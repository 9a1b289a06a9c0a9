"""Configuration objects from plain values: types and ranges checked, errors in one sentence."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, get_type_hints

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

__all__ = ["SettingsError", "build_config", "check_group", "sentence"]


class SettingsError(ValueError):
    """Something on the command line or in conf/ is wrong; the message is one sentence."""


def check_group(path: str, fields: Any) -> None:
    """Refuse a value where a group of keys belongs.

    Raises:
        SettingsError: It is none.
    """
    if not isinstance(fields, Mapping):
        raise SettingsError(f"{path}={fields!r} must be a group of keys, e.g. {path}.KEY=VALUE.")


def build_config(kind: type, path: str, fields: Mapping[str, Any], *, exact: bool = False) -> Any:
    """A configuration object, its types and ranges checked.

    Args:
        kind: Its class, a dataclass or a pydantic model.
        path: Where the fields come from, for messages.
        fields: Values by name.
        exact: Whether every field must be given.

    Raises:
        SettingsError: One sentence that names the field.
    """
    check_group(path, fields)
    if issubclass(kind, BaseModel):
        declared = {f.alias or name: f.annotation for name, f in kind.model_fields.items()}
    else:
        declared = get_type_hints(kind)
        declared = {field.name: declared[field.name] for field in dataclasses.fields(kind)}
    names = list(declared)
    for name, value in fields.items():
        # pydantic would take it for a number
        if isinstance(value, bool) and declared.get(name) is not bool:
            raise SettingsError(f"{path}.{name}={str(value).lower()}: Input should be no boolean.")
    missing = [name for name in names if name not in fields]
    if exact and missing:
        raise SettingsError(f"{path} lacks {', '.join(missing)}.")
    try:
        if issubclass(kind, BaseModel):
            return kind(**fields)
        config = ConfigDict(extra="forbid", allow_inf_nan=False)
        strict = checked_dataclass(kind, config=config, frozen=True)
        checked = TypeAdapter(strict).validate_python(dict(fields))
    except ValidationError as error:
        raise SettingsError(sentence(error, path, names)) from error
    # Hand on the component's own class: the wrapper is for checking only.
    return kind(**{name: getattr(checked, name) for name in names})


def sentence(error: ValidationError, path: str, names: Sequence[str] = ()) -> str:
    """What is wrong, in one sentence; ``names`` are the valid keys."""
    first = error.errors()[0]
    where = ".".join([path, *map(str, first["loc"])] if path else map(str, first["loc"]))
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"Unknown key {where!r}; valid keys there: {', '.join(names)}."
    reason = first["msg"].removeprefix("Value error, ")
    if not first["loc"] or first["type"] == "value_error":
        return f"{where}: {reason}" if where else reason
    return f"{where}={first['input']!r}: {reason}."
