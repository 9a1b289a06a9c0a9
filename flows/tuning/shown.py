"""How a study is shown to people: a note in optuna-dashboard, a view of its trials in MLflow."""

from flows.pipeline.plan import digest
from flows.pipeline.tracking.board import View
from flows.tuning.study import Study

__all__ = ["OBJECTIVE", "study_note", "study_view"]

OBJECTIVE = "held-out loss"
"""Name of what a study minimises."""


def study_note(study: Study, trials: int, record: str, command: str) -> str:
    """What a study is, for those who open its journal, in Markdown.

    Args:
        study: The study.
        trials: Number of trials it gets.
        record: Address of the search's own record; empty if there is none.
        command: How the search is begun and continued.
    """
    about = study.specification
    lines = [
        f"Settings of the model **{about.model}** on the dataset **{about.dataset}**. The "
        f"objective is the {OBJECTIVE} after training, on trajectories that no fit reads; lower "
        f"is better. The first trial is the default configuration; {trials} trials in all.",
        "A pruned trial had a worse loss than the median of the others at the same share of its "
        "budget. A failed one without an error was interrupted and goes on under a new number.",
        f"Begun and continued by `{command}`.",
    ]
    if record:
        lines.append(f"The trials as runs in MLflow: {record} (`python -m flows.ui` serves it).")
    return "\n\n".join(lines)


def study_view(study: Study) -> View:
    """The trials of a study side by side, the best first."""
    about = study.specification
    return View(
        f"study-{digest(study.name, 4)}",
        f"Trials of {about.model} on {about.dataset}",
        where=f"tags.study = '{study.name}'",
        columns=(
            "tags.trial",
            "tags.state",
            "metrics.validation_loss",
            *(f"params.settings.{name}" for name in about.space),
        ),
        order="metrics.validation_loss",
        bars=("validation_loss",),
        lines=("model/validation_loss_on_the_way",),
        board=False,
    )
