"""The search: asks studies for trials, lets an executor fit them, reports the losses back.

A trial is a model-fitting node like any other, so its key finds a finished artifact or a checkpoint
of any earlier run, and a benchmark finds those of the search. The next trial is asked for whenever
a slot is free, and all results up to then enter the choice.
"""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from optuna.trial import Trial, TrialState

from components.core.integrity import DamagedFileError
from flows.pipeline.errors import PipelineError
from flows.pipeline.executors.executor import Executor
from flows.pipeline.failures import failure_line
from flows.pipeline.group import GroupCall, GroupResult
from flows.pipeline.locks import locked
from flows.pipeline.outcome import STOPPED
from flows.pipeline.plan import Node, digest
from flows.pipeline.signals import deferred_signals, exit_code, ignored_signals
from flows.pipeline.store import ArtifactStore
from flows.tuning.outcome import SearchOutcome
from flows.tuning.study import Study
from flows.tuning.trial_queue import TrialQueue
from flows.tuning.trials import Trials

__all__ = ["search"]

_TICK = 0.5  # seconds between two looks at the intermediate losses
_SIGN_OF_LIFE = 60.0  # seconds without a message after which running trials are listed


@dataclass
class _Call:
    """A node being fitted, and the trials that wait for it: more than one if drawn twice."""

    study: Study
    node: Node
    trials: list[Trial]


def search(
    studies: Sequence[Study],
    trials: int,
    store: ArtifactStore,
    tracker: Trials,
    executor: Executor,
    notify: Callable[[str], None],
    finished: Callable[[Study], None] = lambda study: None,
    begun: Callable[[Node], None] = lambda node: None,
    limit: Callable[[], str] = lambda: "",
) -> SearchOutcome:
    """Bring every study to a number of trials.

    Args:
        studies: One per model and dataset; the datasets must be in the store.
        trials: Number of trials that each study gets; those of earlier runs count.
        store: Where artifacts lie.
        tracker: Records the trials; the caller has opened it.
        executor: Computes the fits.
        notify: Takes one-line messages.
        finished: Called with every study that has all its trials, if one of them is complete.
        begun: Called with the node of every trial that is asked for.
        limit: Why to stop, as a clause; empty while there is no reason.

    Returns:
        How the search ended. Nothing is raised for failed trials.

    Raises:
        PipelineError: Another process searches one of the studies, its journal is not what was
            written, or the search cannot start.
    """
    with ExitStack() as held:
        for study in studies:
            lock = locked(store.locks / f"study-{digest(study.name, 8)}.lock", wait=False)
            if not held.enter_context(lock):
                raise PipelineError(
                    f"Another process searches {study.name}: wait for it, or stop it."
                )
        everything = studies, trials, store, tracker, executor, notify, finished, begun, limit
        return _Search(*everything).run()


def _group(key: str) -> str:
    """Name of a trial's call; other than those of plans, whose calls a search must not stop."""
    return f"trial-{key}"


class _Search:
    """One pass over the studies."""

    def __init__(
        self,
        studies: Sequence[Study],
        trials: int,
        store: ArtifactStore,
        tracker: Trials,
        executor: Executor,
        notify: Callable[[str], None],
        finished: Callable[[Study], None],
        begun: Callable[[Node], None],
        limit: Callable[[], str],
    ) -> None:
        self.studies = studies
        self.trials = trials
        self.store = store
        self.executor = executor
        self.notify = notify
        self.finished = finished
        self.begun = begun
        self.limit = limit
        self.stopped = ""
        self.outcome = SearchOutcome()
        self.running: dict[str, _Call] = {}
        self.open = list(studies)
        self.queue = TrialQueue(tracker, store, self._say)
        self.last_message = time.monotonic()

    def run(self) -> SearchOutcome:
        self.store.repair()
        for study in self.studies:
            self._check_losses(study)
        for study in self.studies:
            study.recover()
            self._remove_leftovers(study)
        self.queue.catch_up(self.studies)
        try:
            if any(self._wants(study) for study in self.studies):
                self.executor.start(self._say, self._check_running)
                self._fill()
            self._close()
            while self.running:
                for result in self.executor.wait(_TICK):
                    self._settle(result)
                self._fill()
                self.queue.write()
                self._close()
                self._check_running()
                self._sign_of_life()
        except KeyboardInterrupt:
            self.outcome.interrupted = STOPPED if self.stopped else exit_code()
        finally:
            with ignored_signals() if self.outcome.interrupted else deferred_signals():
                self.executor.stop()
                self.queue.write()
            self.outcome.unrecorded = self.queue.unrecorded
        for study in self.studies:
            if study.best() is None and not self.outcome.interrupted:
                self.outcome.failed.append(study.name)
        return self.outcome

    def _check_losses(self, study: Study) -> None:
        """Compare the losses in the journal, which chooses by them, with those of the fits.

        Raises:
            PipelineError: One differs.
        """
        for trial, node in study.begun():
            there = trial.state is TrialState.COMPLETE and self.store.intact(node.key)
            if there and trial.value != self._loss(node):
                raise study.altered(trial, f"another loss than {self.store.path(node.key)}")

    def _remove_leftovers(self, study: Study) -> None:
        """Remove progress files and work of trials that will not go on, left by a killed driver."""
        keys = {t.user_attrs["key"]: t.state for t in study.trials() if "key" in t.user_attrs}
        for key in keys:
            self.store.clear_progress(_group(key))
        for work in self.store.work_folders():
            if {keys.get(key) for key in work.serves} == {TrialState.PRUNED}:
                with self.store.locked(work.serves, wait=False) as free:
                    if free:
                        self.store.discard(work)

    # New trials

    def _active(self, study: Study) -> int:
        return sum(len(call.trials) for call in self.running.values() if call.study is study)

    def _wants(self, study: Study) -> bool:
        if study.ended + self._active(study) < self.trials:
            return True
        # A study may have its number of trials and still lack that of a new start.
        start = study.start_trial()
        return start is not None and start.state is TrialState.WAITING

    def _fill(self) -> None:
        while len(self.running) < self.executor.slots:
            wanting = [study for study in self.studies if self._wants(study)]
            if not wanting:
                return
            # Few trials of a study at once: each is then chosen knowing more of the others.
            self._begin(min(wanting, key=self._active))

    def _begin(self, study: Study) -> None:
        trial = study.ask()
        try:
            node = study.specification.node_of(trial.params, trial.number)
        except ValueError as error:
            self._failed(study, trial, str(error))
            return
        trial.set_user_attr("key", node.key)
        self.begun(node)
        group = _group(node.key)
        if self.store.intact(node.key):
            self._evaluated(study, trial, node)
        elif group in self.running:
            self.running[group].trials.append(trial)
        else:
            self.running[group] = _Call(study, node, [trial])
            self.store.clear_progress(group)
            executor = self.executor
            self.executor.submit(
                GroupCall.of(
                    group,
                    self.store.root,
                    [node],
                    executor.device,
                    executor.threads,
                    precision=executor.precision,
                )
            )

    # Running trials

    def _check_running(self) -> None:
        """Report intermediate losses to the studies, and stop trials that they prune.

        Raises:
            KeyboardInterrupt: It is time to stop; trials go on from their checkpoints.
        """
        self.stopped = self.limit()
        if self.stopped:
            self._say(f"Stopping, since {self.stopped}.")
            raise KeyboardInterrupt
        for group, call in self.running.items():
            self._report(group, call)
            if self.store.stop_file(group).exists():
                continue
            if any(call.study.should_prune(trial) for trial in call.trials):
                # The study is told first: after a kill in between, the trial does not begin again.
                for trial in call.trials:
                    call.study.mark_for_pruning(trial)
                self.store.stop_file(group).touch()

    def _report(self, group: str, call: _Call) -> None:
        for fraction, loss in self.store.losses(group):
            for trial in call.trials:
                call.study.report(trial, fraction, loss)

    def _sign_of_life(self) -> None:
        if time.monotonic() - self.last_message < _SIGN_OF_LIFE or not self.running:
            return
        shares = [
            f"{call.study.specification.dataset}/{call.study.specification.model} trial "
            f"{call.trials[0].number} {self.store.fraction(group) or 0:.0%}"
            for group, call in self.running.items()
        ]
        self._say(f"running: {', '.join(shares)}")

    def _say(self, text: str) -> None:
        self.last_message = time.monotonic()
        self.notify(text)

    # Results

    def _settle(self, result: GroupResult) -> None:
        call = self.running.pop(result.group)
        self._report(result.group, call)
        for sentence in result.notes:
            self._say(sentence)
        for trial in call.trials:
            if self.store.complete(call.node.key):
                self._evaluated(call.study, trial, call.node)
            elif call.node.key in result.stopped:
                call.study.prune(trial)
                self._ended(call.study, trial, "pruned, worse than the median of the others")
            else:
                damaged = next(iter(result.damaged.values()), "The worker gave no reason")
                reason = result.failed.get(call.node.key, f"{damaged}.")
                self._failed(call.study, trial, reason)
        self.store.clear_progress(result.group)

    def _loss(self, node: Node) -> float | None:
        metrics = self.store.read_json(node.key, "metrics.json")
        return metrics.get("validation_loss") if isinstance(metrics, dict) else None

    def _evaluated(self, study: Study, trial: Trial, node: Node) -> None:
        try:
            loss = self._loss(node)
        except DamagedFileError as error:
            self._failed(study, trial, str(error))
            return
        if loss is None or not math.isfinite(loss):
            self._failed(study, trial, "The held-out loss is missing or not finite.")
            return
        study.complete(trial, float(loss))
        self._ended(study, trial, f"{loss:.6g}")

    def _failed(self, study: Study, trial: Trial, reason: str) -> None:
        study.fail(trial, reason)
        last = failure_line(reason)
        self._ended(study, trial, f"failed: {last}")

    def _ended(self, study: Study, trial: Trial, what: str) -> None:
        best = study.best()
        leads = f"; best {best.value:.6g} of trial {best.number}" if best else ""
        title = f"{study.specification.dataset} {study.specification.model}"
        self._say(f"{title}: trial {trial.number} ({study.ended} of {self.trials}): {what}{leads}")
        self.queue.add(study, trial.number)

    def _close(self) -> None:
        """Call `finished` with the studies that have all their trials."""
        for study in list(self.open):
            if self._wants(study) or self._active(study):
                continue
            self.open.remove(study)
            if study.best() is not None:
                self.finished(study)
