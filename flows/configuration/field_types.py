"""The types of settings by their keys: what a word of a command line is read as.

Whatever a field of text is given is text: a folder's name may look like a number or a list.
"""

import dataclasses
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from typing_extensions import get_type_hints, is_typeddict

__all__ = ["is_optional", "is_switch", "is_text", "is_text_list", "keys_of", "type_at"]


def keys_of(kind: Any) -> dict[str, Any]:
    """The keys of a schema and the types of their values; empty for any other type."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return {field.alias or n: field.annotation for n, field in kind.model_fields.items()}
    if not is_typeddict(kind) and not dataclasses.is_dataclass(kind):
        return {}
    hints = get_type_hints(kind)
    if dataclasses.is_dataclass(kind):
        return {field.name: hints[field.name] for field in dataclasses.fields(kind)}
    return hints


def type_at(kind: Any, key: str) -> Any:
    """The type of a setting; None where the schema does not say.

    Args:
        kind: Schema of all settings.
        key: Full key, such as ``algorithm.lion.updates``. One of a domain has the type of the
            general setting that it changes.
    """
    steps: Sequence[str] = key.split(".")
    if steps[0] == "domain":
        steps = steps[2:]
        if steps[:1] == ["model_for"]:
            steps = ["model", *steps[2:]]
    for step in steps:
        kind = keys_of(_plain(kind)).get(step)
    return kind


def is_text(kind: Any) -> bool:
    """Whether a setting is text, a folder or one of some words."""
    kind = _plain(kind)
    if get_origin(kind) is Literal:
        return all(isinstance(value, str) for value in get_args(kind))
    return kind in (str, Path)


def is_text_list(kind: Any) -> bool:
    """Whether a setting holds any number of texts."""
    return _plain(kind) == tuple[str, ...]


def is_switch(kind: Any) -> bool:
    """Whether a setting is true or false."""
    return _plain(kind) is bool


def is_optional(kind: Any) -> bool:
    """Whether a setting may be null."""
    return type(None) in get_args(_without_annotation(kind))


def _without_annotation(kind: Any) -> Any:
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _plain(kind: Any) -> Any:
    """A type without its annotation, and without null."""
    kind = _without_annotation(kind)
    if get_origin(kind) in (Union, types.UnionType):
        [*some] = [part for part in get_args(kind) if part is not type(None)]
        return some[0] if len(some) == 1 else kind
    return kind
