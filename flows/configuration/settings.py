"""Makes settings of a command line: `load_settings`."""

from collections.abc import Mapping, Sequence
from typing import Any

from flows.configuration.checking import SettingsError
from flows.configuration.field_types import type_at
from flows.configuration.given import settings_of, whole_layers
from flows.configuration.overrides import (
    ALIASES,
    RUNNER_ALIASES,
    check_keys,
    parse_overrides,
    split_overrides,
)
from flows.configuration.schema import Settings

__all__ = ["ALIASES", "RUNNER_ALIASES", "Settings", "SettingsError", "load_settings"]


def load_settings(overrides: Sequence[str], aliases: Mapping[str, str] = ALIASES) -> Settings:
    """Compose and check a configuration.

    Args:
        overrides: Command line words such as ``profile=quick`` or ``seeds=[0,1]``.
        aliases: Short keys and what they stand for.

    Raises:
        SettingsError: Unknown key, name or value; one sentence.
    """
    profile, words = split_overrides(overrides, aliases, _kind_of)
    check_keys(words, whole_layers(profile).base)
    by_model = {word.split(".")[1]: word for word in reversed(words) if word.startswith("model.")}
    return settings_of(profile, parse_overrides(words, _kind_of), by_model)


def _kind_of(key: str) -> Any:
    """The type of a setting."""
    return type_at(Settings, key)
