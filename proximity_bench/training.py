"""Trains policies on a log, with the models that their algorithm needs fitted before."""

import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, overload

import torch

from components.algorithms import ALGORITHMS
from components.algorithms.parts.algorithm import Algorithm
from components.algorithms.parts.training import learner_inputs, train_policies
from components.data.dataset import OfflineDataset
from components.data.sources.held_log import HeldLog
from components.models import MODELS
from components.models.fitting import fit_into
from components.models.supervised import Monitor
from components.training.divergence import DivergedError, diverged
from components.training.memory import keep_freed_memory
from flows.configuration.checking import hint
from flows.configuration.composition import base_layers
from flows.configuration.given import settings_of
from flows.configuration.plants import settings_of_log
from flows.configuration.schema import Settings
from flows.planning.sizes import check_algorithm, check_model, check_size
from proximity_bench.datasets import PROFILE
from proximity_bench.policies import Policy
from proximity_bench.progress import Begin, progress_bars

__all__ = ["chosen_device", "fit_model", "train"]

_SNAPSHOTS: Final = 20  # as in a sweep


@overload
def train(
    log: OfflineDataset,
    algorithm: str,
    *,
    updates: int | None = None,
    seeds: int = 0,
    models: Mapping[str, Mapping[str, Any]] | None = None,
    snapshots: int | None = None,
    device: str = "auto",
    progress: bool = True,
    **settings: Any,
) -> Policy: ...


@overload
def train(
    log: OfflineDataset,
    algorithm: str,
    *,
    updates: int | None = None,
    seeds: Sequence[int],
    models: Mapping[str, Mapping[str, Any]] | None = None,
    snapshots: int | None = None,
    device: str = "auto",
    progress: bool = True,
    **settings: Any,
) -> list[Policy]: ...


def train(
    log: OfflineDataset,
    algorithm: str,
    *,
    updates: int | None = None,
    seeds: int | Sequence[int] = 0,
    models: Mapping[str, Mapping[str, Any]] | None = None,
    snapshots: int | None = None,
    device: str = "auto",
    progress: bool = True,
    **settings: Any,
) -> Policy | list[Policy]:
    """Train policies on a log, after the models that the algorithm needs.

    Settings that are not given are those of `python -m flows.full_benchmark`, with what the
    dataset's file in conf/ and its domain change; the policy is the one of that sweep, too.

    Args:
        log: From :func:`proximity_bench.dataset`.
        algorithm: Its name, such as "lion".
        updates: Budget.
        seeds: One, or several, which are trained side by side as lanes of one program.
        models: By model, settings of its fit, e.g. ``{"recurrent_ensemble": {"updates": 300}}``.
        snapshots: Policies kept, equally spaced; 20, or as many as there are updates.
        device: "cpu", "cuda", or "auto", a GPU where there is one.
        progress: Whether to show bars, one for each fit.
        settings: Further ones of the algorithm, e.g. ``learning_rate=1e-3``.

    Returns:
        The policy of the seed; of several seeds, a list in their order, without those whose
        training diverged before the first snapshot, of which a warning tells.

    Raises:
        ValueError: An unknown name or setting, a log that does not suit, or a training that
            diverged; one sentence.
    """
    alone = not isinstance(seeds, Sequence)
    if updates is not None:
        settings["updates"] = updates
    chosen = _settings(log, algorithm, seeds, models or {}, snapshots or 1, settings)
    record = ALGORITHMS[algorithm]
    budget = chosen.algorithm_on(log.card.name, algorithm).updates
    where = chosen_device(device)
    keep_freed_memory()
    with (
        tempfile.TemporaryDirectory(prefix="proximity_bench-") as folder,
        progress_bars(progress) as begin,
    ):
        work = Path(folder)
        fitted = {
            name: fit_model(name, config, log, where, work, begin)
            for name, config in _models(chosen, log.card.name, record).items()
        }
        found = _train(
            record, log, chosen, fitted, snapshots or min(_SNAPSHOTS, budget), where, work, begin
        )
    stacks = []
    for seed, stack in zip(chosen.seeds, found, strict=True):
        what = f"The training of {algorithm} on {log.card.name}, seed {seed}"
        if isinstance(stack, DivergedError):
            config = asdict(chosen.algorithm_on(log.card.name, algorithm))
            error = DivergedError(diverged(what, stack, f"algorithm.{algorithm}", config))
            if alone or all(isinstance(other, DivergedError) for other in found):
                raise error from stack
            warnings.warn(f"{error} The other seeds are returned.", stacklevel=2)
            continue
        if stack.card.ended_at is not None:
            said = f"{what} diverged by update {stack.card.ended_at}; the last finite policy stays."
            warnings.warn(said, stacklevel=2)
        stacks.append(Policy(stack, seed, log.card, fitted.get("behaviour_policy")))
    return stacks[0] if alone else stacks


def _settings(
    log: OfflineDataset,
    algorithm: str,
    seeds: int | Sequence[int],
    models: Mapping[str, Mapping[str, Any]],
    snapshots: int,
    settings: Mapping[str, Any],
) -> Settings:
    """Checked settings of a training."""
    name, known = log.card.name, base_layers(PROFILE).base["dataset"]
    if algorithm not in ALGORITHMS:
        valid = ", ".join(ALGORITHMS)
        said = f"Unknown algorithm {algorithm!r}; valid ones are {valid}."
        raise ValueError(said + hint(algorithm, ALGORITHMS))
    record = ALGORITHMS[algorithm]
    needs = tuple(dict.fromkeys((*record.needs, *record.transitions)))
    for model in models:
        if model not in needs:
            valid = f"its models are {', '.join(needs)}" if needs else "it needs no models"
            said = f"models={model!r}: {algorithm} is not trained with it; {valid}."
            raise ValueError(said + hint(model, needs))
    source = HeldLog.of(log)
    own: dict[str, Any] = {} if name in known else {"log": "", **settings_of_log(log.card)}
    for setting in settings:  # what is given wins over what follows from the card
        own.get("algorithm", {}).get(algorithm, {}).pop(setting, None)
    own["model_for"] = {algorithm: {model: dict(fields) for model, fields in models.items()}}
    given = {
        "datasets": [name],
        "dataset": {name: own},
        "algorithms": [algorithm],
        "seeds": list(seeds) if isinstance(seeds, Sequence) else [seeds],
        "training": {"snapshots": snapshots},
        "algorithm": {algorithm: dict(settings)},
    }
    chosen = settings_of(PROFILE, given, {})
    chosen = chosen.model_copy(update={"dataset": {name: source}})
    check_size(name, source)
    for config in _models(chosen, name, record).values():
        check_model(chosen, name, config)
    check_algorithm(chosen, name, algorithm)
    return chosen


def _models(settings: Settings, dataset: str, record: Algorithm[Any]) -> dict[str, Any]:
    """Configuration objects of the models that an algorithm needs."""
    own = settings.models_for(dataset, record.name)
    needs = record.models_for(settings.algorithm_on(dataset, record.name))
    return {name: own.get(name, settings.model_on(dataset, name)) for name in needs}


def chosen_device(name: str) -> torch.device:
    """The device of a name.

    Raises:
        ValueError: It is unknown, or not there.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name not in ("cpu", "cuda"):
        raise ValueError(f"device={name!r} is unknown; give cpu, cuda or auto.")
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device='cuda', but PyTorch finds no GPU here; use cpu or auto.")
    return torch.device(name)


def fit_model(
    name: str,
    config: Any,
    log: OfflineDataset,
    device: torch.device,
    work: Path,
    begin: Begin,
    seed: int = 0,
) -> Any:
    """A fitted model, read from the disk as a sweep does; policies of all seeds share it."""
    folder = work / name
    try:
        fit_into(
            folder,
            name,
            log,
            config,
            seed,
            device=device,
            checkpoint=work / f"{name}.safetensors",
            monitor=Monitor(begin(name)),
        )
    except DivergedError as error:
        what = f"The fit of {name} on {log.card.name}"
        raise DivergedError(diverged(what, error, f"model.{name}", asdict(config))) from error
    return MODELS[name].load(folder)


def _train(
    record: Algorithm[Any],
    log: OfflineDataset,
    settings: Settings,
    models: Mapping[str, Any],
    snapshots: int,
    device: torch.device,
    work: Path,
    begin: Begin,
) -> Sequence[Any]:
    """A stack of snapshots for every seed, or why there is none."""
    seeds = settings.seeds
    config = settings.algorithm_on(log.card.name, record.name)
    lanes = {name: [model] * len(seeds) for name, model in models.items()}
    inputs = learner_inputs(record, [log] * len(seeds), seeds, lanes, device)
    training = work / "training"
    training.mkdir()
    try:
        policies, _ = train_policies(
            record,
            record.learner(config, inputs),
            [log] * len(seeds),
            [f"seed{seed}" for seed in seeds],
            updates=config.updates,
            snapshots=snapshots,
            work=training,
            progress=begin(record.name),
            device=device,
        )
    except DivergedError as error:
        return [error] * len(seeds)
    return policies
