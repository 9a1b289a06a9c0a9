"""Chooses the settings of every model on every dataset: the general ones or tuned ones."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from components.models import MODELS
from flows.configuration.checking import SettingsError, build_config
from flows.configuration.files import CONF
from flows.configuration.settings import Settings
from flows.pipeline.plan import Node
from flows.tuning.tuned_file import read_tuned, tuned_path

__all__ = ["ModelChoice", "choose_models", "tuned_folder"]


@dataclass(frozen=True)
class ModelChoice:
    """Settings by (dataset, model).

    Attributes:
        configs: Configuration objects.
        tuned: Those among them that come from a search.
    """

    configs: Mapping[tuple[str, str], Any]
    tuned: frozenset[tuple[str, str]]

    def lines(self) -> list[str]:
        """One line that names the tuned models and one that names the others."""
        kinds = (
            ("tuned", sorted(self.tuned)),
            ("default", sorted(self.configs.keys() - self.tuned)),
        )
        return [
            f"Models with {kind} settings: {', '.join('/'.join(pair) for pair in pairs) or 'none'}."
            for kind, pairs in kinds
        ]


def tuned_folder(settings: Settings) -> Path:
    """Folder of the tuned settings; a relative one is a folder of the project, like conf/."""
    return CONF.parent / settings.models.folder


def choose_models(
    settings: Settings, models: Iterable[str], data: Mapping[str, Node]
) -> ModelChoice:
    """Find the settings of models on datasets.

    Args:
        settings: Of the run.
        models: Names of the models that are needed.
        data: Node of every dataset by name.

    Raises:
        SettingsError: Tuned models are asked for, but none has a file, or a file is damaged or
            was tuned on other data.
    """
    configs = {(d, m): settings.model_on(d, m) for d in data for m in sorted(set(models))}
    if settings.models.source == "default":
        return ModelChoice(configs, frozenset())
    tuned = {pair: found for pair in configs if (found := _tuned(settings, *pair, data[pair[0]]))}
    if not tuned:
        names = sorted({model for _, model in configs})
        raise SettingsError(
            f"models=tuned, but {settings.models.folder} has no file for "
            f"{', '.join(names)} on {', '.join(data)}; make them with "
            f"{_search(','.join(data), ','.join(names))}, or use models=default."
        )
    for _, model in sorted(tuned):
        if model in settings.model_overrides:
            raise SettingsError(
                f"{settings.model_overrides[model]!r} has no effect with models=tuned, whose files "
                f"hold every setting of {model}; remove it or use models=default."
            )
    return ModelChoice(configs | tuned, frozenset(tuned))


def _search(datasets: str, models: str) -> str:
    return f"'python -m flows.tune_models datasets=[{datasets}] models=[{models}]'"


def _tuned(settings: Settings, dataset: str, model: str, data: Node) -> Any:
    folder = tuned_folder(settings)
    shown = tuned_path(settings.models.folder, dataset, model)
    remedy = f"make it again with {_search(dataset, model)}, or use models=default"
    try:
        found = read_tuned(folder, dataset, model)
        if found is None:
            return None
        if found.data_key != data.key:
            raise ValueError("it was tuned on other data than these settings make")
        return build_config(MODELS[model].config, "settings", found.settings, exact=True)
    except (ValueError, OSError) as error:
        reason = str(error).rstrip(".")
        raise SettingsError(f"{shown} cannot be used ({reason}); {remedy}.") from error
