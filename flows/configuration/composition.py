"""Merges defaults, the files of conf/ and a command line, layer by layer.

Nothing is checked against types here; :mod:`flows.configuration.schema` does that afterwards.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import Field

from flows.configuration.checking import SettingsError, StrictModel, build_config, hint
from flows.configuration.defaults import component_defaults
from flows.configuration.files import (
    CONF,
    ConfFolder,
    foreign_in,
    names_in,
    read_datasets,
    read_file,
    read_folder,
)
from flows.configuration.renamed import rename_old_keys

__all__ = [
    "DEVIATIONS",
    "Layers",
    "base_layers",
    "by_name_only",
    "merged",
    "special_settings",
    "with_limits",
]


class Deviations(StrictModel):
    """Settings that a domain or a dataset changes for itself.

    Attributes:
        algorithm: Settings by algorithm.
        model: Settings by model.
        model_for: By algorithm, settings of the models that it uses, by model.
        by_name_only: Whether `datasets=all` leaves its datasets out: what is no part of the
            benchmark, such as a sanity check, must not grow its grid.
    """

    algorithm: dict[str, dict[str, Any]] = Field(default_factory=dict)
    model: dict[str, dict[str, Any]] = Field(default_factory=dict)
    model_for: dict[str, dict[str, dict[str, Any]]] = Field(default_factory=dict)
    by_name_only: bool = False


class Limits(StrictModel):
    """What the algorithms and models that a profile does not name have at most, by field."""

    algorithm: dict[str, int] = Field(default_factory=dict)
    model: dict[str, int] = Field(default_factory=dict)


DEVIATIONS = tuple(Deviations.model_fields)
"""Keys of a dataset's file that say nothing of how the data is made."""


@dataclass(frozen=True)
class Layers:
    """The layers below the command line.

    Attributes:
        lower: Defaults of components with the datasets and domains of conf/.
        upper: What wins over them, conf/config.yaml with the profile, its `others` spelled out.
        base: Both merged.
        datasets: The files of conf/dataset, own ones too.
        domains: The files of conf/domain.
        foreign: Sentences about files of conf/ that are not read.
    """

    lower: DictConfig
    upper: DictConfig
    base: DictConfig
    datasets: ConfFolder
    domains: ConfFolder
    foreign: tuple[str, ...]


@cache
def base_layers(profile: str) -> Layers:
    """The layers below the command line. They are cached: the caller must not change them.

    Raises:
        SettingsError: There is no such profile, or its file or conf/config.yaml is wrong.
    """
    valid = names_in(CONF / "profile")
    if profile not in valid:
        raise SettingsError(
            f"Unknown profile {profile!r}; valid ones are {', '.join(valid)}."
            + hint(profile, valid)
        )
    datasets, domains = read_datasets(CONF / "dataset"), read_folder(CONF / "domain")
    chosen = merged(
        [read_file(CONF / "config.yaml"), read_file(CONF / "profile" / f"{profile}.yaml")]
    )
    defaults = component_defaults()
    limited = with_limits(chosen, defaults)
    groups = {"dataset": datasets.content, "domain": domains.content}
    lower, upper = OmegaConf.create(defaults | groups), rename_old_keys(limited)
    foreign = [s for group in ("dataset", "domain", "profile") for s in foreign_in(CONF / group)]
    return Layers(lower, upper, merged([lower, upper]), datasets, domains, tuple(foreign))


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


def by_name_only(whole: Mapping[str, Any]) -> set[str]:
    """Datasets that `datasets=all` leaves out, by their own file or that of their domain.

    Args:
        whole: All layers merged, as plain groups.
    """
    found = set()
    for name, fields in _files(whole).items():
        named = fields.get("domain")
        domain = whole["domain"].get(named) if isinstance(named, str) else None
        of_domain = domain if isinstance(domain, Mapping) else {}
        if fields.get("by_name_only", of_domain.get("by_name_only", False)) is True:
            found.add(name)
    return found


def merged(layers: Sequence[DictConfig]) -> DictConfig:
    """One configuration made of several; later layers win."""
    return OmegaConf.merge(*layers)  # type: ignore[return-value]


def special_settings(
    layers: Sequence[DictConfig], datasets: Collection[str]
) -> dict[str, dict[str, Any]]:
    """Settings of algorithms and models where a dataset or its domain has its own.

    In every layer (conf/, profile, command line) a domain wins over what holds everywhere, and a
    dataset over its domain; a later layer wins over all of an earlier one.

    Args:
        layers: Later ones win.
        datasets: Names of those that are chosen.

    Returns:
        By place, `domain.NAME` for the domains of these datasets and of the last layer, then
        `dataset.NAME` for those that have some of their own: `algorithm`
        and `model`, settings by name; `model_for`, by algorithm the settings of the models that
        differ for it.

    Raises:
        SettingsError: A dataset names a domain that has no file, or a domain or a dataset changes
            settings of algorithms and models in something that is not a group of keys.
    """
    whole: Any = OmegaConf.to_container(merged(layers), resolve=True)
    files = {name: fields for name, fields in _files(whole).items() if name in datasets}
    domains = {name: _domain(name, fields, whole["domain"]) for name, fields in files.items()}
    found = {}
    changed = layers[-1].get("domain") or {}
    for domain in sorted({*filter(None, domains.values()), *changed}):
        build_config(Deviations, f"domain.{domain}", whole["domain"][domain])
        found[f"domain.{domain}"] = _special(layers, ((), ("domain", domain)))
    for name, fields in files.items():
        own = {key: value for key, value in fields.items() if key in DEVIATIONS}
        build_config(Deviations, f"dataset.{name}", own)
        if own or domains[name]:
            above = (("domain", domains[name]),) if domains[name] else ()
            found[f"dataset.{name}"] = _special(layers, ((), *above, ("dataset", name)))
    return found


def _domain(name: str, fields: Mapping[str, Any], domains: Mapping[str, Any]) -> str:
    """The domain of a dataset; empty if it has none."""
    domain = fields.get("domain")
    if domain is None:
        return ""
    if not isinstance(domain, str) or domain not in domains:
        raise SettingsError(
            f"dataset.{name}.domain={domain!r} has no file in conf/domain; valid ones are "
            f"{', '.join(domains)}."
        )
    return domain


def _special(
    layers: Sequence[DictConfig], places: Sequence[tuple[str, ...]]
) -> dict[str, dict[str, Any]]:
    """Settings of algorithms and models that several places give, later places before others."""
    own = {group: _merged_group(group, layers, places) for group in ("algorithm", "model")}
    wanted = _merged_group("model_for", layers, places)
    own["model_for"] = {
        algorithm: {model: own["model"].get(model, {}) | fields for model, fields in of.items()}
        for algorithm, of in wanted.items()
    }
    return own


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
