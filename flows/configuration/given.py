"""Makes settings of a profile and given values, those of a command line or of a Python call."""

from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from flows.configuration.checking import SettingsError, build_config, first_line
from flows.configuration.composition import (
    Layers,
    base_layers,
    by_name_only,
    merged,
    special_settings,
)
from flows.configuration.schema import Settings
from flows.configuration.sections import selected

__all__ = ["settings_of", "whole_layers"]


def settings_of(
    profile: str, given: Mapping[str, Any] | DictConfig, model_overrides: Mapping[str, str]
) -> Settings:
    """Put given values over those of conf/ and a profile, and check all of them.

    Args:
        profile: Its name.
        given: Values in nested groups; datasets that conf/ does not have may be among them.
        model_overrides: See :class:`Settings`.

    Raises:
        SettingsError: Unknown key, name or value; one sentence.
    """
    layers = whole_layers(profile)
    try:
        own = given if isinstance(given, DictConfig) else OmegaConf.create(dict(given))
        values = _values(layers, own)
    except OmegaConfBaseException as error:
        raise SettingsError(f"{first_line(error)}; write a plain value.") from error
    values["profile_name"] = profile
    values["model_overrides"] = dict(model_overrides)
    settings: Settings = build_config(Settings, "", values)
    return settings


_COMPOSED = ("profile_name", "special", "model_overrides", "notes")  # stand in no file


def whole_layers(profile: str) -> Layers:
    """The layers below the given values.

    Raises:
        SettingsError: Also where conf/config.yaml has lost settings.
    """
    layers = base_layers(profile)
    if lacking := [key for key in Settings.model_fields if key not in {*layers.base, *_COMPOSED}]:
        raise SettingsError(
            f"conf/config.yaml lacks {', '.join(lacking)}; take it from the project as it was."
        )
    return layers


def _values(layers: Layers, given: DictConfig) -> dict[str, Any]:
    """All values, of datasets those of the chosen ones alone.

    Raises:
        SettingsError: A chosen dataset is unknown, or its file or that of its domain is wrong.
    """
    values: Any = OmegaConf.to_container(merged([layers.base, given]), resolve=True)
    files, domains = layers.datasets, layers.domains
    valid = {*files.content, *files.broken, *map(str, given.get("dataset") or ())}
    left_out = by_name_only(values) if values["datasets"] == "all" else set()
    chosen = selected("dataset", values["datasets"], sorted(valid - left_out))
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
