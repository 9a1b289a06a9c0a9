"""Overrides on a command line: ``key=value``, read by the type of the setting.

Text is taken as it was typed, lists of names are split at their commas, and all other values follow
Hydra's grammar.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from flows.configuration.checking import SettingsError, hint
from flows.configuration.field_types import is_optional, is_switch, is_text, is_text_list
from flows.configuration.renamed import RENAMED, rename_old_keys
from flows.configuration.words import split_word

__all__ = [
    "ALIASES",
    "RUNNER_ALIASES",
    "check_keys",
    "parse_overrides",
    "split_overrides",
]

RUNNER_ALIASES: Mapping[str, str] = {
    name: f"runner.{name}" for name in ("repair", "max_hours", "until")
}
"""Those of every door that runs a sweep."""

ALIASES: Mapping[str, str] = {
    "models": "models.source",
    "pack": "runner.pack",
    **RUNNER_ALIASES,
}
"""Short keys of the command line and the full keys they stand for; a door may have others."""

KindOf = Callable[[str], Any]
"""The type of a setting, by its full key; None where nothing is known of it."""


def split_overrides(
    words: Sequence[str], aliases: Mapping[str, str], kind_of: KindOf
) -> tuple[str, list[str]]:
    """The profile, and the other overrides with full keys under their names of today.

    Args:
        words: Of the command line.
        aliases: Short keys and what they stand for.
        kind_of: Types of settings.

    Raises:
        SettingsError: A word is no key=value, or two give the profile different names.
    """

    def is_on_off(key: str) -> bool:
        return is_switch(kind_of(aliases.get(key, key)))

    profiles, rest = [], []
    for word in words:
        key, value = split_word(word, is_on_off)
        if key in ("profile", "profile_name"):  # the latter is how it is shown
            profiles.append(value)
            continue
        key = aliases.get(key, key)
        group, _, name = key.rpartition(".")
        name = RENAMED.get((group, name), name)
        rest.append(f"{group}.{name}={value}" if group else f"{name}={value}")
    if len(set(profiles)) > 1:
        given = " and ".join(f"profile={name}" for name in profiles)
        raise SettingsError(f"{given} contradict each other; give profile once.")
    return (profiles or ["paper"])[0], rest


def parse_overrides(words: Sequence[str], kind_of: KindOf) -> DictConfig:
    """The values of overrides, as a nested configuration.

    Args:
        words: Overrides with full keys.
        kind_of: Types of settings.

    Raises:
        SettingsError: A word cannot be read, or contradicts another one.
    """
    parsed = OmegaConf.create({})
    given: dict[str, tuple[str, Any]] = {}
    parser = OverridesParser.create()
    for word in words:
        key, _, text = word.partition("=")
        kind = kind_of(key)
        if is_text(kind):
            value: Any = None if text == "null" and is_optional(kind) else _unquoted(text)
        elif is_text_list(kind):
            value = _texts(key, text)
        else:
            value = _grammatical(parser, word)
        for leaf, part in _leaves(key, value):
            first, before = given.setdefault(leaf, (word, part))
            if repr(before) != repr(part):  # as text, because NaN differs from itself
                raise SettingsError(
                    f"{first!r} and {word!r} contradict each other; give {leaf} once."
                )
        OmegaConf.update(parsed, key, value, force_add=True)
    return rename_old_keys(parsed)


def _unquoted(text: str) -> str:
    """Text as it was typed, without quotation marks around all of it."""
    quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "'\""
    return text[1:-1] if quoted else text


def _texts(key: str, text: str) -> list[str] | str:
    """The names in a list, each as it was typed, or a single one, such as `all`."""
    if not text.startswith("["):
        if "," in text:
            raise _without_brackets(f"{key}={text}", key)
        return _unquoted(text)
    try:
        names = yaml.load(text, yaml.BaseLoader)
    except yaml.YAMLError as error:
        raise _unreadable(f"{key}={text}") from error
    if not all(isinstance(name, str) for name in names):
        raise _unreadable(f"{key}={text}")
    return list(names)


def _grammatical(parser: OverridesParser, word: str) -> Any:
    """A value in Hydra's grammar."""
    try:
        override = parser.parse_override(word)
    except HydraException as error:
        raise _unreadable(word) from error
    if override.is_sweep_override():
        raise _without_brackets(word, override.key_or_group)
    return override.value()


def _without_brackets(word: str, key: str) -> SettingsError:
    return SettingsError(f"{word!r} lists values without brackets; write {key}=[...].")


def _unreadable(word: str) -> SettingsError:
    return SettingsError(
        f"{word!r} cannot be read; write key=value with lists as [a,b], without a comma at the end."
    )


def _leaves(key: str, value: Any) -> list[tuple[str, Any]]:
    """The settings that a word gives, in groups or alone."""
    if not isinstance(value, Mapping) or not value:
        return [(key, value)]
    return [leaf for name, part in value.items() for leaf in _leaves(f"{key}.{name}", part)]


def check_keys(words: Sequence[str], base: DictConfig) -> None:
    """Refuse unknown keys, and single values in place of groups.

    Args:
        words: Overrides with full keys.
        base: A configuration with every valid key.

    Raises:
        SettingsError: Names the valid siblings of the first unknown key.
    """
    special = {
        "algorithm": base["algorithm"],
        "model": base["model"],
        "model_for": dict.fromkeys(base["algorithm"], base["model"]),
    }
    domains = dict.fromkeys(base["domain"], special)
    tree = {**base, "domain": domains, "variants": base["algorithm"]}
    for word in words:
        key, _, value = word.partition("=")
        if key == "dataset" or key.startswith("dataset."):
            raise SettingsError(
                f"{word!r}: what stands in conf/dataset cannot be given here; edit its files, or "
                f"select with datasets={value if key == 'dataset' and value else '[...]'}."
            )
        node: Any = tree
        walked: list[str] = []
        for part in key.split("."):
            if not isinstance(node, Mapping) or part not in node:
                valid = sorted(map(str, node)) if isinstance(node, Mapping) else []
                place = f" in {'.'.join(walked)}" if walked else ""
                listing = f"; valid keys{place}: {', '.join(valid)}" if valid else ""
                unknown = ".".join([*walked, part])
                raise SettingsError(f"Unknown key {unknown!r}{listing}.{hint(part, valid)}")
            node = node[part]
            walked.append(part)
        if isinstance(node, Mapping) and not value.startswith(("{", "${")):
            meant = f" Did you mean {f'{key}s={value}'!r}?" if f"{key}s" in base else ""
            raise SettingsError(f"{word} must be a group of keys, e.g. {key}.KEY=VALUE.{meant}")
