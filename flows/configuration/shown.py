"""All settings as YAML, for `show_settings=true`."""

from typing import Any

import yaml

from flows.configuration.schema import Settings

__all__ = ["settings_yaml"]

_HEAD = """\
# Every setting as it is now. On a command line: KEY.KEY=VALUE, e.g. algorithm.lion.updates=200.
# Settings that a dataset changes stand below it; change them in conf/dataset and conf/domain.
"""


def settings_yaml(settings: Settings) -> str:
    """Every setting, in the groups of the command line; datasets only if they are chosen."""
    shown = settings.model_dump(
        mode="json", exclude={"special", "model_overrides", "notes", "dataset", "show_settings"}
    )
    shown["dataset"] = {name: _dataset(settings, name) for name in settings.datasets}
    return _HEAD + yaml.dump(shown, Dumper=_Dumper, sort_keys=False, width=100)


def _dataset(settings: Settings, name: str) -> dict[str, Any]:
    """The source of a dataset, and the settings that hold on it alone."""
    dumped = settings.model_dump(mode="json", include={"dataset": {name}, "special": {name}})
    found: dict[str, Any] = {k: v for k, v in dumped["dataset"][name].items() if k != "name"}
    own = dumped["special"].get(name)
    if own is None:
        return found
    general = settings.model_dump(mode="json", include={"algorithm", "model"})
    for group in ("algorithm", "model"):
        found |= _group(group, _differences(own[group], general[group]))
    wanted = {a: _differences(models, own["model"]) for a, models in own["model_for"].items()}
    return found | _group("model_for", wanted)


def _differences(own: dict[str, Any], general: dict[str, Any]) -> dict[str, Any]:
    """By name, the settings that are not the general ones."""
    differing = {
        name: {key: value for key, value in fields.items() if value != general[name][key]}
        for name, fields in own.items()
    }
    return {name: fields for name, fields in differing.items() if fields}


def _group(name: str, content: dict[str, Any]) -> dict[str, Any]:
    return {name: content} if content else {}


class _Dumper(yaml.SafeDumper):
    """Lists in one line."""

    def represent_list(self, data: list[Any]) -> yaml.Node:
        return self.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True)


_Dumper.add_representer(list, _Dumper.represent_list)
