"""The ended trials of a search that its tracker has not recorded yet."""

import contextlib
from collections.abc import Callable, Iterable

from optuna.trial import FrozenTrial, TrialState

from flows.pipeline.errors import TrackingError
from flows.pipeline.store import ArtifactStore
from flows.tuning.study import Study, has_ended
from flows.tuning.trials import TrialRecord, Trials

__all__ = ["TrialQueue"]


class TrialQueue:
    """Trials in the order in which they ended, until the tracker has recorded them.

    A tracker that fails once is not asked again: the studies hold everything, so the next run of
    the search records what is missing.

    Args:
        tracker: Records the trials.
        store: Where artifacts lie.
        say: Takes one-line messages.

    Attributes:
        unrecorded: Why trials are missing in the tracker; empty if none is.
    """

    def __init__(self, tracker: Trials, store: ArtifactStore, say: Callable[[str], None]) -> None:
        self.unrecorded = ""
        self._tracker = tracker
        self._store = store
        self._say = say
        self._waiting: list[tuple[Study, int]] = []

    def add(self, study: Study, number: int) -> None:
        """Adds a trial that ended."""
        self._waiting.append((study, number))

    def catch_up(self, studies: Iterable[Study]) -> None:
        """Records the trials that an earlier run of the search has left out."""
        for study in studies:
            try:
                known = self._tracker.recorded(study.name)
            except TrackingError as error:
                self._close(error)
                return
            ended = [trial.number for trial in study.trials() if trial.state.is_finished()]
            self._waiting += [(study, number) for number in ended if number not in known]
        self.write()

    def write(self) -> None:
        """Records the waiting trials."""
        while self._waiting and not self.unrecorded:
            study, number = self._waiting[0]
            try:
                self._tracker.log_trial(self._record(study, study.trials()[number]))
            except TrackingError as error:
                self._close(error)
                return
            self._waiting.pop(0)

    def _close(self, error: TrackingError) -> None:
        self.unrecorded = str(error)
        self._say(f"{error} The search goes on; the next run of it records what is missing.")

    def _record(self, study: Study, trial: FrozenTrial) -> TrialRecord:
        node = None
        # The settings may be impossible, or the trial interrupted before all of them were drawn.
        with contextlib.suppress(ValueError, KeyError):
            node = study.specification.node_of(trial.params, trial.number)
        complete = trial.state is TrialState.COMPLETE
        return TrialRecord(
            study=study.name,
            number=trial.number,
            state=trial.state.name if has_ended(trial) else "INTERRUPTED",
            parameters=trial.params,
            loss=trial.value if complete else None,
            intermediate_losses=trial.intermediate_values,
            node=node,
            folder=self._store.path(node.key) if complete and node is not None else None,
            reason=trial.user_attrs.get("error", ""),
        )
