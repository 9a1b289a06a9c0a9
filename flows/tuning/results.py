"""The results of a search: tuned settings, a sentence about them, the best losses so far."""

from collections.abc import Iterable
from dataclasses import asdict
from datetime import date

from optuna.trial import TrialState

from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.tracker import Metrics
from flows.tuning.study import Study
from flows.tuning.tuned_file import TunedModel

__all__ = ["best_losses", "comparison", "tuned_model"]


def tuned_model(study: Study, store: ArtifactStore) -> TunedModel | None:
    """The content of a study's tuned file; None if no trial is complete.

    Args:
        study: The study.
        store: Where its dataset lies.
    """
    best, start, specification = study.best(), study.start_trial(), study.specification
    if best is None:
        return None
    card = store.read_json(specification.data.key, "dataset/card.json")
    started = start is not None and start.state is TrialState.COMPLETE
    return TunedModel(
        dataset=specification.dataset,
        model=specification.model,
        study=study.name,
        trial=best.number,
        trials=study.ended,
        validation_loss=best.value,
        default_validation_loss=start.value if started else None,
        data_digest=card["digest"],
        data_key=specification.data.key,
        date=date.today().isoformat(),
        settings=asdict(study.config(best)),
    )


def comparison(tuned: TunedModel) -> str:
    """The best loss beside that of the default configuration, without a final stop."""
    text = f"{tuned.dataset} {tuned.model}: trial {tuned.trial} of {tuned.trials} with a held-out "
    text += f"loss of {tuned.validation_loss:.6g}"
    default = tuned.default_validation_loss
    if default is None:
        return f"{text}; the default could not be evaluated"
    gain = 1.0 - tuned.validation_loss / default if default else 0.0
    return f"{text}; the default has {default:.6g} ({gain:.1%} less)"


def best_losses(studies: Iterable[Study]) -> Metrics:
    """Per study the best loss so far over the number of the trial."""
    curves: dict[str, list[tuple[int, float]]] = {}
    for study in studies:
        best = float("inf")
        for trial in study.trials():
            if trial.state is TrialState.COMPLETE:
                best = min(best, trial.value)
                name = f"best_loss/{study.specification.dataset}/{study.specification.model}"
                curves.setdefault(name, []).append((trial.number, best))
    return curves
