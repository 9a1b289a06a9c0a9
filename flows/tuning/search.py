"""The search: asks for trials, has workers evaluate them, tells the studies what came of it.

A trial is a model-fitting node like any other, so its key finds a finished artifact or a checkpoint
wherever these come from, and a benchmark finds those of the search. Whenever a slot is free the
next trial is asked for, with all that is known by then.
"""

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from optuna.trial import Trial, TrialState

from flows.pipeline.errors import PipelineError
from flows.pipeline.executors.executor import Executor
from flows.pipeline.files import read_json
from flows.pipeline.locks import locked
from flows.pipeline.plan import Node, digest
from flows.pipeline.store import ArtifactStore
from flows.pipeline.worker import GroupCall, GroupResult
from flows.tuning.study import Study
from flows.tuning.trial_queue import TrialQueue
from flows.tuning.trials import Trials

__all__ = ["Outcome", "search"]

_TICK = 0.5  # seconds between two looks at the losses on the way
_SIGN_OF_LIFE = 60.0  # seconds of silence after which people hear of running trials


@dataclass
class Outcome:
    """What became of a search.

    Attributes:
        failed: Names of studies of which no trial could be evaluated.
        interrupted: Whether somebody pressed Ctrl-C.
        unrecorded: Why trials are missing in MLflow; empty if none is.
    """

    failed: list[str] = field(default_factory=list)
    interrupted: bool = False
    unrecorded: str = ""

    @property
    def status(self) -> str:
        """MLflow's word for it."""
        return "KILLED" if self.interrupted else "FAILED" if self.failed else "FINISHED"

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, 1 if a study has nothing to show, else 0."""
        return 130 if self.interrupted else int(bool(self.failed))


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
) -> Outcome:
    """Bring every study to a number of trials.

    Args:
        studies: What is searched; the datasets must be in the store.
        trials: That each study shall have; those of earlier runs count.
        store: Where artifacts lie.
        tracker: Who remembers the trials.
        executor: Who fits.
        notify: Takes one-line messages for people.
        finished: Called with every study that has its trials, one of them complete.

    Returns:
        What became of it. Nothing is raised for failed trials.

    Raises:
        PipelineError: Another process searches one of the studies, or the search cannot start.
    """
    with ExitStack() as held:
        for study in studies:
            lock = locked(store.locks / f"study-{digest(study.name, 8)}.lock", wait=False)
            if not held.enter_context(lock):
                raise PipelineError(
                    f"Another process searches {study.name}: wait for it, or stop it."
                )
        return _Search(studies, trials, store, tracker, executor, notify, finished).run()


def _group(key: str) -> str:
    """Name of a trial's call: not a plan's, whose calls nobody here may stop."""
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
    ) -> None:
        self.studies = studies
        self.trials = trials
        self.store = store
        self.executor = executor
        self.notify = notify
        self.finished = finished
        self.outcome = Outcome()
        self.running: dict[str, _Call] = {}
        self.open = list(studies)
        self.queue = TrialQueue(tracker, store, self._say)
        self.heard = time.monotonic()

    def run(self) -> Outcome:
        self.store.repair()
        for study in self.studies:
            study.recover()
            self._tidy(study)
        self.queue.catch_up(self.studies)
        try:
            if any(self._wants(study) for study in self.studies):
                self.executor.start(self._say, self._look)
                self._fill()
            self._close()
            while self.running:
                for result in self.executor.wait(_TICK):
                    self._settle(result)
                self._fill()
                self.queue.write()
                self._close()
                self._look()
                self._sign_of_life()
        except KeyboardInterrupt:
            self.outcome.interrupted = True
        finally:
            self.executor.stop()
            with contextlib.suppress(KeyboardInterrupt):
                self.queue.write()
            self.outcome.unrecorded = self.queue.closed
        for study in self.studies:
            if study.best() is None and not self.outcome.interrupted:
                self.outcome.failed.append(study.name)
        return self.outcome

    def _tidy(self, study: Study) -> None:
        """Remove what a killed driver left of trials that will not go on."""
        keys = {t.user_attrs["key"]: t.state for t in study.trials() if "key" in t.user_attrs}
        for key in keys:
            self.store.forget_progress(_group(key))
        for work in self.store.works():
            if {keys.get(key) for key in work.serves} == {TrialState.PRUNED}:
                with self.store.locked(work.serves, wait=False) as free:
                    if free:
                        self.store.discard(work)

    # Asking

    def _active(self, study: Study) -> int:
        return sum(len(call.trials) for call in self.running.values() if call.study is study)

    def _wants(self, study: Study) -> bool:
        if study.spent + self._active(study) < self.trials:
            return True
        start = study.start_trial()  # may be new in an old study that has its number
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
            node = study.subject.node_of(trial.params, trial.number)
        except ValueError as error:
            self._failed(study, trial, str(error))
            return
        trial.set_user_attr("key", node.key)
        group = _group(node.key)
        if self.store.complete(node.key):
            self._evaluated(study, trial, node)
        elif group in self.running:
            self.running[group].trials.append(trial)
        else:
            self.running[group] = _Call(study, node, [trial])
            self.store.forget_progress(group)
            executor = self.executor
            self.executor.submit(
                GroupCall.of(group, self.store.root, [node], executor.device, executor.threads)
            )

    # Watching

    def _look(self) -> None:
        """Pass losses on the way to the studies, and stop what is hopeless."""
        for group, call in self.running.items():
            self._report(group, call)
            if self.store.stop_file(group).exists():
                continue
            if any(call.study.hopeless(trial) for trial in call.trials):
                # First in the study: a kill in between shall not begin the trial once more.
                for trial in call.trials:
                    call.study.give_up(trial)
                self.store.stop_file(group).touch()

    def _report(self, group: str, call: _Call) -> None:
        for fraction, loss in self.store.losses(group):
            for trial in call.trials:
                call.study.report(trial, fraction, loss)

    def _sign_of_life(self) -> None:
        if time.monotonic() - self.heard < _SIGN_OF_LIFE or not self.running:
            return
        shares = [
            f"{call.study.subject.dataset}/{call.study.subject.model} trial "
            f"{call.trials[0].number} {self.store.fraction(group) or 0:.0%}"
            for group, call in self.running.items()
        ]
        self._say(f"running: {', '.join(shares)}")

    def _say(self, text: str) -> None:
        self.heard = time.monotonic()
        self.notify(text)

    # Telling

    def _settle(self, result: GroupResult) -> None:
        call = self.running.pop(result.group)
        self._report(result.group, call)
        for trial in call.trials:
            if self.store.complete(call.node.key):
                self._evaluated(call.study, trial, call.node)
            elif call.node.key in result.given_up:
                call.study.prune(trial)
                self._ended(call.study, trial, "given up, worse than the median of the others")
            else:
                reason = result.failed.get(call.node.key, "The worker said nothing.")
                self._failed(call.study, trial, reason)
        self.store.forget_progress(result.group)

    def _evaluated(self, study: Study, trial: Trial, node: Node) -> None:
        metrics = read_json(self.store.path(node.key) / "metrics.json")
        loss = metrics.get("validation_loss") if isinstance(metrics, dict) else None
        if loss is None or not math.isfinite(loss):
            self._failed(study, trial, f"The held-out loss is {loss}.")
            return
        study.complete(trial, float(loss))
        self._ended(study, trial, f"{loss:.6g}")

    def _failed(self, study: Study, trial: Trial, reason: str) -> None:
        study.fail(trial, reason)
        last = (reason.strip() or "no reason given").splitlines()[-1]
        self._ended(study, trial, f"failed: {last}")

    def _ended(self, study: Study, trial: Trial, what: str) -> None:
        best = study.best()
        leads = f"; best {best.value:.6g} of trial {best.number}" if best else ""
        title = f"{study.subject.dataset} {study.subject.model}"
        self._say(f"{title}: trial {trial.number} ({study.spent} of {self.trials}): {what}{leads}")
        self.queue.add(study, trial.number)

    def _close(self) -> None:
        """Hand over the studies that have all they shall have."""
        for study in list(self.open):
            if self._wants(study) or self._active(study):
                continue
            self.open.remove(study)
            if study.best() is not None:
                self.finished(study)
