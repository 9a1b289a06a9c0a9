"""Overrides on a command line: ``key=value`` in Hydra's grammar."""

from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from flows.configuration.checking import SettingsError, hint

__all__ = ["ALIASES", "check_keys", "parse_overrides", "rename_old_keys", "split_overrides"]

ALIASES: Mapping[str, str] = {"models": "models.source", "repair": "runner.repair"}
"""Short keys of the command line and the full keys they stand for; a door may have others."""

_RENAMED = {("evaluation", "lambda_step"): "proximity_step"}
"""Old keys, each with its group, and their names of today."""


def split_overrides(words: Sequence[str], aliases: Mapping[str, str]) -> tuple[str, list[str]]:
    """The profile, and the other overrides with full keys under their names of today.

    Raises:
        SettingsError: A word is no key=value.
    """
    profile, rest = "paper", []
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key or key[0] in "+~":
            raise SettingsError(f"{word!r} is not an override; write key=value, e.g. seeds=[0,1].")
        if key == "profile":
            profile = value
            continue
        key = aliases.get(key, key)
        group, _, name = key.rpartition(".")
        name = _RENAMED.get((group, name), name)
        rest.append(f"{group}.{name}={value}" if group else f"{name}={value}")
    return profile, rest


def rename_old_keys(layer: DictConfig) -> DictConfig:
    """Give old keys of a file or a command line their names of today; changes the layer."""
    for (group, old), new in _RENAMED.items():
        fields = layer.get(group)
        if isinstance(fields, DictConfig) and old in fields:
            fields[new] = fields.pop(old)
    return layer


def parse_overrides(words: Sequence[str]) -> DictConfig:
    """The values of overrides, as a nested configuration.

    Raises:
        SettingsError: A word does not follow the grammar.
    """
    parsed = OmegaConf.create({})
    parser = OverridesParser.create()
    for word in words:
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
    return rename_old_keys(parsed)


def check_keys(words: Sequence[str], base: DictConfig) -> None:
    """Refuse unknown keys.

    Args:
        words: Overrides with full keys.
        base: A configuration with every valid key.

    Raises:
        SettingsError: Names the valid siblings of the first unknown key.
    """
    for word in words:
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
