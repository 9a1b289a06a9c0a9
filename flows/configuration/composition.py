"""Merges defaults, the files of conf/ and a command line, layer by layer.

Nothing is checked against types here; :mod:`flows.configuration.schema` does that afterwards.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import Field

from flows.configuration.checking import SettingsError, StrictModel, build_config, hint
from flows.configuration.defaults import component_defaults
from flows.configuration.files import CONF, names_in, read_file, read_folder
from flows.configuration.overrides import rename_old_keys

__all__ = ["DEVIATIONS", "base_layers", "merged", "special_settings", "with_limits"]


class Deviations(StrictModel):
    """Settings that a domain or a dataset changes for itself.

    Attributes:
        algorithm: Settings by algorithm.
        model: Settings by model.
        model_for: By algorithm, settings of the models that it uses, by model.
    """

    algorithm: dict[str, dict[str, Any]] = Field(default_factory=dict)
    model: dict[str, dict[str, Any]] = Field(default_factory=dict)
    model_for: dict[str, dict[str, dict[str, Any]]] = Field(default_factory=dict)


class Limits(StrictModel):
    """What the algorithms and models that a profile does not name have at most, by field."""

    algorithm: dict[str, int] = Field(default_factory=dict)
    model: dict[str, int] = Field(default_factory=dict)


DEVIATIONS = tuple(Deviations.model_fields)
"""Keys of a dataset's file that change settings of algorithms and models."""


@cache
def base_layers(profile: str) -> tuple[DictConfig, DictConfig, DictConfig]:
    """The layers below the command line. They are cached: the caller must not change them.

    Returns:
        Defaults of components with the datasets and domains of conf/; what wins over them,
        conf/config.yaml with the profile, its `others` spelled out; and both merged.

    Raises:
        SettingsError: There is no such profile, or a file of conf/ is wrong.
    """
    valid = names_in(CONF / "profile")
    if profile not in valid:
        raise SettingsError(
            f"Unknown profile {profile!r}; valid ones are {', '.join(valid)}."
            + hint(profile, valid)
        )
    groups = {group: read_folder(CONF / group) for group in ("dataset", "domain")}
    chosen = merged(
        [read_file(CONF / "config.yaml"), read_file(CONF / "profile" / f"{profile}.yaml")]
    )
    defaults = component_defaults()
    limited = with_limits(chosen, defaults)
    lower, upper = OmegaConf.create(defaults | groups), rename_old_keys(limited)
    return lower, upper, merged([lower, upper])


def with_limits(chosen: DictConfig, defaults: Mapping[str, Any]) -> DictConfig:
    """Settings for the algorithms and models that a profile does not name.

    Its group `others` says what they have at most, e.g. `others.algorithm.updates`. Those that have
    such a field get this much, or their default where that is less.

    Args:
        chosen: conf/config.yaml with the profile.
        defaults: By group and name, see `component_defaults`.

    Returns:
        The same with settings of all algorithms and models in place of `others`.

    Raises:
        SettingsError: `others` holds anything but whole numbers by group and field.
    """
    limits = build_config(Limits, "others", chosen.get("others", {})).model_dump()
    unnamed = {
        group: {
            name: {key: min(fields[key], most[key]) for key in most if key in fields}
            for name, fields in defaults[group].items()
            if _node(chosen, (group, name)) is None
        }
        for group, most in limits.items()
    }
    rest = OmegaConf.masked_copy(chosen, [key for key in chosen if key != "others"])
    return merged([OmegaConf.create(unnamed), rest])


def merged(layers: Sequence[DictConfig]) -> DictConfig:
    """One configuration made of several; later layers win."""
    return OmegaConf.merge(*layers)  # type: ignore[return-value]


def special_settings(layers: Sequence[DictConfig]) -> dict[str, dict[str, Any]]:
    """Settings of algorithms and models by dataset, where it or its domain has its own.

    In every layer (conf/, profile, command line) a domain wins over what holds everywhere, and a
    dataset over its domain; a later layer wins over all of an earlier one.

    Returns:
        By dataset: `algorithm` and `model`, settings by name; `model_for`, by algorithm the
        settings of the models that differ for it.

    Raises:
        SettingsError: A dataset names a domain that has no file, or a domain or a dataset changes
            settings of algorithms and models in something that is not a group of keys.
    """
    whole: Any = OmegaConf.to_container(merged(layers), resolve=True)
    _check_deviations(whole)
    domains = layers[0].domain
    found = {}
    for name, dataset in _files(whole).items():
        if not {"domain", *DEVIATIONS} & set(dataset):
            continue
        places: tuple[tuple[str, ...], ...] = ((), ("dataset", name))
        domain = dataset.get("domain")
        if domain is not None:
            if domain not in domains:
                raise SettingsError(
                    f"dataset.{name}.domain={domain!r} has no file in conf/domain; valid ones are "
                    f"{', '.join(domains)}."
                )
            places = ((), ("domain", domain), ("dataset", name))
        own = {group: _merged_group(group, layers, places) for group in ("algorithm", "model")}
        wanted = _merged_group("model_for", layers, places)
        own["model_for"] = {
            algorithm: {model: own["model"].get(model, {}) | fields for model, fields in of.items()}
            for algorithm, of in wanted.items()
        }
        found[str(name)] = own
    return found


def _check_deviations(whole: Mapping[str, Any]) -> None:
    """Check that domains and datasets change settings in groups of known keys."""
    if not isinstance(whole["domain"], Mapping):
        raise SettingsError(
            f"domain={whole['domain']!r} must be a group of keys, e.g. domain.KEY=VALUE."
        )
    for name, fields in whole["domain"].items():
        build_config(Deviations, f"domain.{name}", fields)
    for name, fields in _files(whole).items():
        own = {key: value for key, value in fields.items() if key in DEVIATIONS}
        build_config(Deviations, f"dataset.{name}", own)


def _files(whole: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The files of conf/dataset by name; one that is no group of keys is refused by the schema."""
    files = whole["dataset"] if isinstance(whole["dataset"], Mapping) else {}
    return {str(name): fields for name, fields in files.items() if isinstance(fields, Mapping)}


def _merged_group(
    group: str, layers: Sequence[DictConfig], places: Sequence[tuple[str, ...]]
) -> dict[str, Any]:
    """A group merged from all layers: all places of a layer come before those of the next."""
    nodes = [_node(layer, (*place, group)) for layer in layers for place in places]
    merged = OmegaConf.merge({}, *(node for node in nodes if isinstance(node, DictConfig)))
    plain: Any = OmegaConf.to_container(merged, resolve=True)
    return dict(plain)


def _node(layer: Any, path: Sequence[str]) -> Any:
    """The value at a path, or None; names may contain dots."""
    for part in path:
        layer = layer.get(part) if isinstance(layer, DictConfig) else None
    return layer
