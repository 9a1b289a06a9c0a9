"""Schemas of logs from YAML files and mappings; their groups are shown as YAML writes them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from omegaconf import OmegaConf

from components.data.imports.schema import LogSchema
from flows.configuration.checking import SettingsError, build_config
from flows.configuration.field_types import keys_of
from flows.configuration.files import read_file

__all__ = ["checked_schema", "fields_in"]

_GROUPS: Final[Mapping[str, str]] = {
    "actions": "NAME: [LEAST, LARGEST]",
    "reward_weights": "NAME: WEIGHT",
    "known": "bounds: [LEAST, LARGEST] and features:",
}
"""What stands below the keys that are groups."""


def fields_in(path: Path) -> Any:
    """What a schema file holds.

    Raises:
        SettingsError: It cannot be read.
    """
    return OmegaConf.to_container(read_file(path), resolve=False)


def checked_schema(fields: Any, path: str = "") -> LogSchema:
    """A schema of plain values.

    Args:
        fields: Values by key.
        path: Where they come from, for messages about keys; may be empty.

    Raises:
        SettingsError: One sentence.
    """
    if isinstance(fields, Mapping) and set(fields) <= set(keys_of(LogSchema)):
        for name, below in _GROUPS.items():
            given = fields.get(name, {})
            where = f"{path}.{name}" if path else name
            if name == "actions" and name in fields and not given:
                raise SettingsError(f"{where} names none; write {below} below it.")
            if given is not None and not isinstance(given, Mapping):
                raise SettingsError(f"{where} is {given!r}; write {below} below it.")
    schema: LogSchema = build_config(LogSchema, path, fields)
    return schema
