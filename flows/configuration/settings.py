"""Makes settings of a command line: `load_settings`."""

from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from flows.configuration.checking import SettingsError, build_config, first_line
from flows.configuration.composition import base_layers, merged, special_settings
from flows.configuration.overrides import ALIASES, check_keys, parse_overrides, split_overrides
from flows.configuration.schema import Settings

__all__ = ["ALIASES", "Settings", "SettingsError", "load_settings"]


def load_settings(overrides: Sequence[str], aliases: Mapping[str, str] = ALIASES) -> Settings:
    """Compose and check a configuration.

    Args:
        overrides: Command line words such as ``profile=quick`` or ``seeds=[0,1]``.
        aliases: Short keys and what they stand for.

    Raises:
        SettingsError: Unknown key, name or value; one sentence.
    """
    profile, words = split_overrides(overrides, aliases)
    *layers, base = base_layers(profile)
    check_keys(words, base)
    try:
        given = parse_overrides(words)
        values: Any = OmegaConf.to_container(merged([base, given]), resolve=True)
        values["special"] = special_settings([*layers, given])
    except OmegaConfBaseException as error:
        raise SettingsError(f"{first_line(error)}; write a plain value.") from error
    del values["domain"]  # now part of `special`
    values["model_overrides"] = {
        word.split(".")[1]: word for word in reversed(words) if word.startswith("model.")
    }
    settings: Settings = build_config(Settings, "", values)
    return settings
