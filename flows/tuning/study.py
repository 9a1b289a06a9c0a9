"""One search: the Optuna study of a model on a dataset, kept in a journal file.

The study's name ends in a digest of all that its losses depend on and that is not searched, so a
study never mixes losses that cannot be compared. The driver alone writes. It may be killed at any
line; :meth:`Study.recover` then repairs the study:

- a trial that was running is failed, and its parameters are enqueued again: the new trial means
  the same node, so its checkpoint or its finished artifact is used;
- a trial that was marked for pruning is pruned, whether or not its worker has stopped.

A trial that failed by itself has a reason among its attributes and counts. One that was
interrupted has none and does not count.
"""

import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import distribution_to_json
from optuna.exceptions import ExperimentalWarning
from optuna.storages.journal import JournalStorage
from optuna.trial import FrozenTrial, Trial, TrialState

from flows.pipeline.errors import PipelineError
from flows.pipeline.failures import failure_line
from flows.pipeline.plan import Node, digest
from flows.tuning import space as spaces
from flows.tuning.journal import open_journal

__all__ = ["Study", "StudySpecification", "ended_trials", "has_ended"]

_RANDOM_FIRST = 10  # trials before the sampler begins to learn, as by Optuna's default
_COMPARED_FROM = 5  # complete trials before any is pruned
_PATIENCE = 25  # percent of the budget that every trial gets
_NOTE, _VERSION = "dashboard:note_str:0", "dashboard:note_ver"  # of optuna-dashboard
_COMPARED = 3  # losses at the same percentage that a comparison needs


@dataclass(frozen=True)
class StudySpecification:
    """A model on a dataset, and what is varied.

    Attributes:
        dataset: Its name.
        model: Name of the model.
        start: Configuration object the search starts from; its first trial.
        space: What is varied.
        data: The dataset's node.
        node: Makes the node that fits a configuration.
    """

    dataset: str
    model: str
    start: Any
    space: spaces.Space
    data: Node
    node: Callable[[Any], Node]

    @property
    def name(self) -> str:
        """Of the study: equal names hold comparable losses."""
        drawn = spaces.distributions(self.space, self.start)
        decisive = {
            "data": self.data.key,
            "fit": self.node(self.start).version,
            "fixed": spaces.fixed(self.space, self.start),
            "space": {name: distribution_to_json(kind) for name, kind in drawn.items()},
            "space_version": spaces.VERSION,
        }
        return f"{self.dataset}/{self.model}/{digest(decisive, 4)}"

    def node_of(self, drawn: Mapping[str, Any], number: int) -> Node:
        """The node of a trial.

        Raises:
            ValueError: The configuration is impossible.
        """
        made = self.node(spaces.settings(self.space, self.start, drawn))
        return replace(made, name=f"{made.name}/trial{number}")


def ended_trials(path: Path, specifications: Iterable[StudySpecification]) -> dict[str, int]:
    """Number of ended trials by study name; changes nothing.

    Args:
        path: The journal.
        specifications: Those of the studies.
    """
    found = dict.fromkeys((specification.name for specification in specifications), 0)
    if not path.exists():
        return found
    journal = open_journal(path)
    there = set(optuna.get_all_study_names(journal))
    for name in found.keys() & there:
        study = optuna.load_study(study_name=name, storage=journal)
        found[name] = sum(map(has_ended, study.get_trials(deepcopy=False)))
    return found


class Study:
    """A study that several runs of the driver continue, one after the other."""

    def __init__(self, specification: StudySpecification, journal: JournalStorage) -> None:
        """Opens the study or makes it.

        Args:
            specification: The model, the dataset and what is varied.
            journal: See :func:`open_journal`.
        """
        self.specification = specification
        self.name = specification.name
        self._space = spaces.distributions(specification.space, specification.start)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            self._study = optuna.create_study(
                storage=journal, study_name=self.name, direction="minimize", load_if_exists=True
            )
            self._study.sampler = optuna.samplers.TPESampler(
                # Every run of the driver has another seed: with the same it would draw the same.
                seed=(int(digest(self.name, 4), 16) + len(self.trials())) % 2**32,
                n_startup_trials=_RANDOM_FIRST,
            )
        self._study.pruner = optuna.pruners.MedianPruner(
            n_startup_trials=_COMPARED_FROM, n_warmup_steps=_PATIENCE, n_min_trials=_COMPARED
        )
        self._reported: dict[int, int] = {}
        self._start = spaces.parameters(specification.space, specification.start)

    def describe(self, objective: str, note: str) -> None:
        """Name what is minimised and leave a note, both as optuna-dashboard shows them.

        Args:
            objective: What a trial's value is.
            note: Markdown.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            if self._study.metric_names != [objective]:
                self._study.set_metric_names([objective])
        storage, number = self._study._storage, self._study._study_id
        known = storage.get_study_system_attrs(number)
        # The dashboard's own function needs it installed; a journal may be opened elsewhere.
        if known.get(_NOTE) != note:
            storage.set_study_system_attr(number, _NOTE, note)
            storage.set_study_system_attr(number, _VERSION, int(known.get(_VERSION, 0)) + 1)

    def trials(self) -> list[FrozenTrial]:
        """All trials so far, in order."""
        return self._study.get_trials(deepcopy=False)

    @property
    def ended(self) -> int:
        """Number of trials that count: evaluated, pruned or failed by themselves."""
        return sum(has_ended(trial) for trial in self.trials())

    def begun(self) -> list[tuple[FrozenTrial, Node]]:
        """The trials that have a node, and what they compute.

        Raises:
            PipelineError: The journal holds other parameters than were drawn for a trial.
        """
        found = []
        for trial in self.trials():
            key = trial.user_attrs.get("key")
            if key is None:
                continue
            try:
                node = self.specification.node_of(trial.params, trial.number)
            except (ValueError, KeyError):
                node = None
            if node is None or node.key != key:
                raise self.altered(trial, "parameters that do not belong to its fit")
            found.append((trial, node))
        return found

    def altered(self, trial: FrozenTrial, what: str) -> PipelineError:
        """The error about a trial of which the journal holds something that was not written."""
        return PipelineError(
            f"The journal of {self.name} is damaged (trial {trial.number} has {what}): set "
            "the file optuna/journal.log in the store aside and give the same command again; "
            "finished fits are found in the store and not made again."
        )

    def recover(self) -> None:
        """Repair the study after a killed driver, and enqueue the start if it is missing."""
        for trial in self.trials():
            if trial.state is not TrialState.RUNNING:
                continue
            if "given_up" in trial.user_attrs:
                self._study.tell(trial.number, state=TrialState.PRUNED)
                continue
            drawn = trial.system_attrs.get("fixed_params", {}) | trial.params
            again = {t.user_attrs.get("continues") for t in self.trials()}
            if drawn and trial.number not in again:
                attributes = {k: v for k, v in trial.user_attrs.items() if k == "start"}
                self._study.enqueue_trial(drawn, attributes | {"continues": trial.number})
            # In this order: a kill between the two leaves a running trial, not a lost one.
            self._study.tell(trial.number, state=TrialState.FAIL)
        if self.start_trial() is None:
            self._study.enqueue_trial(self._start, {"start": self._start})

    def start_trial(self) -> FrozenTrial | None:
        """The trial of the configuration the search starts from, unless it was interrupted."""
        found = [t for t in self.trials() if t.user_attrs.get("start") == self._start]
        lost = TrialState.FAIL
        return next((t for t in found if has_ended(t) or t.state is not lost), None)

    def ask(self) -> Trial:
        """A new trial, or the next enqueued one."""
        return self._study.ask(self._space)

    def report(self, trial: Trial, fraction: float, loss: float) -> None:
        """Note an intermediate held-out loss.

        Args:
            trial: A running trial.
            fraction: Part of the budget that is spent.
            loss: Held-out loss there.
        """
        percent = int(100 * fraction + 1e-9)
        if percent > self._reported.get(trial.number, 0):
            self._reported[trial.number] = percent
            trial.report(loss if math.isfinite(loss) else math.nan, percent)

    def should_prune(self, trial: Trial) -> bool:
        """Whether a running trial is worse than the median of the others at the same budget.

        The answer may change without a new loss of its own: with every other trial that ends.
        """
        return trial.should_prune()

    def mark_for_pruning(self, trial: Trial) -> None:
        """Note that a running trial will be pruned; its later results do not count."""
        trial.set_user_attr("given_up", self._reported[trial.number])

    def complete(self, trial: Trial, loss: float) -> None:
        """End a trial with its loss."""
        self._study.tell(trial, loss)

    def prune(self, trial: Trial) -> None:
        """End a pruned trial."""
        self._study.tell(trial, state=TrialState.PRUNED)

    def fail(self, trial: Trial, reason: str) -> None:
        """End a trial that could not be evaluated, for a reason of its own."""
        last = failure_line(reason)
        trial.set_user_attr("error", last)
        self._study.tell(trial, state=TrialState.FAIL)

    def best(self) -> FrozenTrial | None:
        """The complete trial of the lowest loss, the earliest of equals."""
        done = [t for t in self.trials() if t.state is TrialState.COMPLETE]
        return min(done, key=lambda t: (t.value, t.number), default=None)

    def config(self, trial: FrozenTrial) -> Any:
        """The configuration object of a trial."""
        return spaces.settings(self.specification.space, self.specification.start, trial.params)


def has_ended(trial: FrozenTrial) -> bool:
    """Whether a trial was evaluated, pruned or failed by itself: not waiting, not interrupted."""
    if trial.state is TrialState.FAIL:
        return "error" in trial.user_attrs
    return trial.state.is_finished()
