"""The files of conf/, a profile and the words of a command line, joined layer by layer.

Hydra's compose API reads conf/, its grammar the words. What joins them knows no types: settings
are checked afterwards, by :mod:`flows.configuration.settings`.
"""

import difflib
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from flows.configuration.checking import SettingsError

__all__ = [
    "CONF",
    "GROUPS",
    "check_keys",
    "compose_profile",
    "first_line",
    "hint",
    "merge",
    "names_in",
    "parse_overrides",
    "special_settings",
]

CONF = Path(__file__).resolve().parents[2] / "conf"

GROUPS = ("dataset", "domain", "algorithm", "model")
"""Folders of conf/ that are read whole."""


def names_in(group: str) -> list[str]:
    """The files of a folder of conf/, by name."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def hint(word: str, valid: Iterable[str]) -> str:
    """A further sentence that names the most similar valid word; empty if none is."""
    close = difflib.get_close_matches(word, list(valid), n=1)
    return f" Did you mean {close[0]!r}?" if close else ""


@cache
def compose_profile(profile: str) -> tuple[DictConfig, DictConfig]:
    """The groups of conf/, and what comes on top of them; not to be changed by the caller.

    The groups come first, so that the profile's budgets win over their defaults.
    """
    joined = [f"+{group}=[{','.join(names_in(group))}]" for group in GROUPS]
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            groups = compose("groups", overrides=joined)
            chosen = compose("config", overrides=[f"profile={profile}"])
            merge(groups, chosen)  # a profile with an unknown key ends here
            return groups, chosen
    except (HydraException, OmegaConfBaseException) as error:
        raise SettingsError(first_line(error)) from error


def merge(*layers: Any) -> DictConfig:
    """Later layers win; groups of the first one take new keys at their top only."""
    first, *rest = layers
    base = first.copy()
    OmegaConf.set_struct(base, False)
    merged: DictConfig = OmegaConf.merge(base, *rest)  # type: ignore[assignment]
    OmegaConf.set_struct(merged, True)
    return merged


def special_settings(layers: Sequence[DictConfig]) -> dict[str, dict[str, Any]]:
    """Settings of algorithms and models by dataset, where it or its domain has its own.

    In every layer (conf/, profile, command line) a domain wins over what holds everywhere, and a
    dataset over its domain; a later layer wins over all of an earlier one.

    Returns:
        By dataset: `algorithm` and `model`, settings by name; `model_for`, by algorithm those of
        the models that it wants otherwise.

    Raises:
        SettingsError: A dataset names a domain that has no file.
    """
    domains = layers[0].domain
    found = {}
    for name, dataset in layers[0].dataset.items():
        domain = dataset.get("domain") if isinstance(dataset, DictConfig) else None
        if domain is None:
            continue
        if domain not in domains:
            raise SettingsError(
                f"dataset.{name}.domain={domain!r} has no file in conf/domain; valid ones are "
                f"{', '.join(domains)}."
            )
        places = ((), ("domain", domain), ("dataset", name))
        own = {group: _joined(layers, places, group) for group in ("algorithm", "model")}
        wanted = _joined(layers, places, "model_for")
        own["model_for"] = {
            algorithm: {model: own["model"].get(model, {}) | fields for model, fields in of.items()}
            for algorithm, of in wanted.items()
        }
        found[str(name)] = own
    return found


def _joined(
    layers: Sequence[DictConfig], places: Sequence[tuple[str, ...]], group: str
) -> dict[str, Any]:
    """What the layers say of a group, at all places of a layer before the next layer's."""
    said = [n for layer in layers for p in places if (n := _node(layer, (*p, group))) is not None]
    joined: Any = OmegaConf.to_container(OmegaConf.merge({}, *said), resolve=True)
    return dict(joined)


def _node(layer: Any, path: Sequence[str]) -> Any:
    """What lies at a path, or None; names may hold dots."""
    for part in path:
        layer = layer.get(part) if isinstance(layer, DictConfig) else None
    return layer


def parse_overrides(overrides: Sequence[str]) -> DictConfig:
    """Values of overrides by Hydra's grammar, as a nested configuration."""
    parsed = OmegaConf.create({})
    parser = OverridesParser.create()
    for word in overrides:
        try:
            override = parser.parse_override(word)
        except HydraException as error:
            raise SettingsError(
                f"{word!r} cannot be read; write key=value with lists as [a,b]."
            ) from error
        if override.is_sweep_override():
            raise SettingsError(
                f"{override.input_line!r} lists values without brackets; write "
                f"{override.key_or_group}=[...]."
            )
        OmegaConf.update(parsed, override.key_or_group, override.value(), force_add=True)
    return parsed


def first_line(error: Exception) -> str:
    """What an error says first; others say much more than people want to read."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def check_keys(overrides: Sequence[str], base: DictConfig) -> None:
    """Name the valid siblings of the first unknown key."""
    for word in overrides:
        if word.startswith("dataset."):
            raise SettingsError(
                f"{word!r}: dataset names hold dots, so their keys cannot be given here; edit "
                "conf/dataset, or select with datasets=[...]."
            )
        node: Any = base
        walked: list[str] = []
        for part in word.partition("=")[0].split("."):
            if not isinstance(node, DictConfig) or part not in node:
                valid = sorted(map(str, node)) if isinstance(node, DictConfig) else []
                place = f" in {'.'.join(walked)}" if walked else ""
                listing = f"; valid keys{place}: {', '.join(valid)}" if valid else ""
                unknown = ".".join([*walked, part])
                raise SettingsError(f"Unknown key {unknown!r}{listing}.{hint(part, valid)}")
            node = node[part]
            walked.append(part)
