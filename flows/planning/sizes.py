"""Datasets that are too small or too little described for what is to learn from them."""

from typing import Any

from components.data.dynamics import DynamicsSpecification
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.source import DatasetSource
from components.data.sources.stored_log import StoredLog
from components.data.sources.world import WorldSpec
from components.models.mlp_ensemble.config import MLPEnsembleConfig
from components.models.recurrent_ensemble.ensemble import RecurrentEnsembleConfig
from flows.configuration.checking import SettingsError
from flows.configuration.schema import Settings

__all__ = ["check_algorithm", "check_model", "check_size", "suits"]


def check_model(settings: Settings, dataset: str, model: Any) -> None:
    """Refuse a model that a dataset is too small, too short or too little described for.

    Args:
        settings: What is wanted.
        dataset: Name of the dataset.
        model: Configuration object of the model.

    Raises:
        SettingsError: Trajectories never fill an observation, there is none to hold out, they are
            too short for a recurrent ensemble, or the card of a stored log does not tell the
            dynamics specification that transition models need.
    """
    source = settings.dataset[dataset]
    stored = isinstance(source, StoredLog)
    check_size(dataset, source)
    if stored and isinstance(model, RecurrentEnsembleConfig | MLPEnsembleConfig):
        try:
            DynamicsSpecification.of_card(source.card)
        except ValueError as error:
            raise SettingsError(
                f"{dataset}: {str(error).rstrip('.')}; or choose algorithms that need no "
                "transition model."
            ) from error
    if not isinstance(model, RecurrentEnsembleConfig):
        return
    if source.steps < model.warm_up + model.horizon:
        size = (
            f"{dataset} has {source.steps} steps an episode, which"
            if stored or isinstance(source, WorldSpec)
            else (f"data.steps={settings.data.steps}")
        )
        raise SettingsError(
            f"{size} is less than warm_up + horizon = "
            f"{model.warm_up + model.horizon} of model.recurrent_ensemble; use longer episodes, or "
            "lower warm_up or horizon."
        )


def suits(settings: Settings, dataset: str, model: Any) -> bool:
    """Whether :func:`check_model` lets a model pass."""
    try:
        check_model(settings, dataset, model)
    except SettingsError:
        return False
    return True


def check_size(dataset: str, source: DatasetSource) -> None:
    """Refuse a dataset without a single whole observation, or of a single episode."""
    if source.steps < source.history:
        raise SettingsError(
            f"{dataset} has {source.steps} steps an episode and never fills an observation of "
            f"{source.history} frames; use longer episodes (data.steps)."
        )
    if isinstance(source, RobotSpec) and source.transitions <= source.steps:
        raise SettingsError(
            f"{dataset}: data.transitions={source.transitions} may be a single episode of up to "
            f"{source.steps} steps, and models hold one out; raise data.transitions or lower "
            "data.steps."
        )
    if isinstance(source, StoredLog) and source.card.trajectories < 2:
        raise SettingsError(
            f"{dataset} has a single episode, and models hold one out; log at least two."
        )


def check_algorithm(settings: Settings, dataset: str, name: str) -> None:
    """Refuse an algorithm that finds nothing to learn from in a dataset's short episodes."""
    config, source = settings.algorithm_on(dataset, name), settings.dataset[dataset]
    if source.steps <= getattr(config, "start_after", 0):
        raise SettingsError(
            f"algorithm.{name}.start_after={config.start_after}, but {dataset} has {source.steps} "
            "steps an episode; lower start_after."
        )
    # Episodes that end with a fall may be shorter: nothing is earned after it.
    whole = isinstance(source, IndustrialSpec | WorldSpec)
    if whole and source.steps < getattr(config, "window", 0):
        raise SettingsError(
            f"algorithm.{name}.window={config.window}, but {dataset} has {source.steps} steps an "
            "episode; lower window or use longer episodes."
        )
