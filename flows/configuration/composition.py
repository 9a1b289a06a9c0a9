"""Defaults, the files of conf/ and a command line, joined layer by layer.

This knows no types: what is joined is checked afterwards, by :mod:`flows.configuration.schema`.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import Field

from flows.configuration.checking import SettingsError, Strict, build_config, hint
from flows.configuration.defaults import component_defaults
from flows.configuration.files import CONF, names_in, read_file, read_folder
from flows.configuration.words import modernise

__all__ = ["DEVIATIONS", "base_layers", "joined", "special_settings"]


class Deviations(Strict):
    """What a domain or a dataset wants otherwise than the rest.

    Attributes:
        algorithm: Settings by algorithm.
        model: Settings by model.
        model_for: By algorithm, settings of the models that it uses.
    """

    algorithm: dict[str, dict[str, Any]] = Field(default_factory=dict)
    model: dict[str, dict[str, Any]] = Field(default_factory=dict)
    model_for: dict[str, dict[str, dict[str, Any]]] = Field(default_factory=dict)


DEVIATIONS = tuple(Deviations.model_fields)
"""Keys of a dataset's file that say nothing about the data."""


@cache
def base_layers(profile: str) -> tuple[DictConfig, DictConfig]:
    """What holds before the command line; not to be changed by the caller.

    Returns:
        Defaults of components with the datasets and domains of conf/; and what wins over them:
        conf/config.yaml with the profile.

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
    chosen = joined(
        [read_file(CONF / "config.yaml"), read_file(CONF / "profile" / f"{profile}.yaml")]
    )
    return OmegaConf.create(component_defaults() | groups), modernise(chosen)


def joined(layers: Sequence[DictConfig]) -> DictConfig:
    """One configuration of several; later layers win."""
    return OmegaConf.merge(*layers)  # type: ignore[return-value]


def special_settings(layers: Sequence[DictConfig]) -> dict[str, dict[str, Any]]:
    """Settings of algorithms and models by dataset, where it or its domain has its own.

    In every layer (conf/, profile, command line) a domain wins over what holds everywhere, and a
    dataset over its domain; a later layer wins over all of an earlier one.

    Returns:
        By dataset: `algorithm` and `model`, settings by name; `model_for`, by algorithm those of
        the models that it wants otherwise.

    Raises:
        SettingsError: A dataset names a domain that has no file, or a domain or a dataset says
            something about algorithms and models that is no group of keys.
    """
    whole: Any = OmegaConf.to_container(joined(layers), resolve=True)
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
        own = {group: _said_of(group, layers, places) for group in ("algorithm", "model")}
        wanted = _said_of("model_for", layers, places)
        own["model_for"] = {
            algorithm: {model: own["model"].get(model, {}) | fields for model, fields in of.items()}
            for algorithm, of in wanted.items()
        }
        found[str(name)] = own
    return found


def _check_deviations(whole: Mapping[str, Any]) -> None:
    """See that domains and datasets say things in groups of known keys."""
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
    """What is said of every dataset; what is no group of keys is refused by the schema."""
    files = whole["dataset"] if isinstance(whole["dataset"], Mapping) else {}
    return {str(name): fields for name, fields in files.items() if isinstance(fields, Mapping)}


def _said_of(
    group: str, layers: Sequence[DictConfig], places: Sequence[tuple[str, ...]]
) -> dict[str, Any]:
    """What the layers say of a group, at all places of a layer before the next layer's."""
    said = [_node(layer, (*place, group)) for layer in layers for place in places]
    merged = OmegaConf.merge({}, *(node for node in said if isinstance(node, DictConfig)))
    plain: Any = OmegaConf.to_container(merged, resolve=True)
    return dict(plain)


def _node(layer: Any, path: Sequence[str]) -> Any:
    """What lies at a path, or None; names may hold dots."""
    for part in path:
        layer = layer.get(part) if isinstance(layer, DictConfig) else None
    return layer
