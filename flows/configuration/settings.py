"""Makes settings of a command line: `load_settings`."""

from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from flows.configuration.checking import SettingsError, build_config, first_line
from flows.configuration.composition import Layers, base_layers, merged, special_settings
from flows.configuration.field_types import type_at
from flows.configuration.overrides import ALIASES, check_keys, parse_overrides, split_overrides
from flows.configuration.schema import Settings
from flows.configuration.sections import selected

__all__ = ["ALIASES", "Settings", "SettingsError", "load_settings"]


def load_settings(overrides: Sequence[str], aliases: Mapping[str, str] = ALIASES) -> Settings:
    """Compose and check a configuration.

    Args:
        overrides: Command line words such as ``profile=quick`` or ``seeds=[0,1]``.
        aliases: Short keys and what they stand for.

    Raises:
        SettingsError: Unknown key, name or value; one sentence.
    """
    profile, words = split_overrides(overrides, aliases, _kind_of)
    layers = base_layers(profile)
    if lacking := [key for key in Settings.model_fields if key not in {*layers.base, *_COMPOSED}]:
        raise SettingsError(
            f"conf/config.yaml lacks {', '.join(lacking)}; take it from the project as it was."
        )
    check_keys(words, layers.base)
    try:
        values = _values(layers, parse_overrides(words, _kind_of))
    except OmegaConfBaseException as error:
        raise SettingsError(f"{first_line(error)}; write a plain value.") from error
    values["profile_name"] = profile
    values["model_overrides"] = {
        word.split(".")[1]: word for word in reversed(words) if word.startswith("model.")
    }
    settings: Settings = build_config(Settings, "", values)
    return settings


_COMPOSED = ("profile_name", "special", "model_overrides", "notes")  # stand in no file


def _kind_of(key: str) -> Any:
    """The type of a setting."""
    return type_at(Settings, key)


def _values(layers: Layers, given: DictConfig) -> dict[str, Any]:
    """All values, of datasets those of the chosen ones alone.

    Raises:
        SettingsError: A chosen dataset is unknown, or its file or that of its domain is wrong.
    """
    values: Any = OmegaConf.to_container(merged([layers.base, given]), resolve=True)
    files, domains = layers.datasets, layers.domains
    chosen = selected("dataset", values["datasets"], sorted({*files.content, *files.broken}))
    for name in chosen:
        fields = values["dataset"].get(name)
        domain = fields.get("domain") if isinstance(fields, Mapping) else None
        for error in (files.broken.get(name), domains.broken.get(str(domain))):
            if error is not None:
                raise error
    del values["domain"]  # becomes part of `special`
    values["datasets"] = chosen
    values["dataset"] = {name: values["dataset"][name] for name in chosen}
    values["special"] = special_settings([layers.lower, layers.upper, given], chosen)
    unused = [*files.broken.values(), *domains.broken.values(), *layers.foreign]
    values["notes"] = [str(problem) for problem in unused]
    return dict(values)
