"""The display: the plan before the work, one line per component during it.

On a terminal the lines stay in place. In a file or a log a line is written when its numbers change,
at most every 15 seconds per component. Everything goes to stderr.
"""

import time

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from flows.pipeline.audit import Audit, audit
from flows.pipeline.plan import Plan
from flows.pipeline.run_state import ComponentState, RunState
from flows.pipeline.schedule import form_groups
from flows.pipeline.store import ArtifactStore

__all__ = ["Display", "duration"]

_BETWEEN = 15.0  # least seconds between two lines about one component in a log
_DAY = 24 * 3600.0
_LONG = 3 * _DAY  # from which on a time span is told in days
_SIGN_OF_LIFE = 60.0  # seconds after which a running component is logged without a change
_REDRAW = 0.5  # least seconds between two looks at a run
_SHARE = 20.0  # and least time between them, in units of what the last one took: 5 % of the driver
_WIDTH = 80  # columns that a file or a pipe has at least, whatever COLUMNS says


def duration(seconds: float) -> str:
    """A time span as text, e.g. "2 h 30 min" or "79 days"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    if whole >= _LONG:
        return f"{round(seconds / _DAY):,} days"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes:02d} min"


class Display:
    """Shows a plan and its progress."""

    def __init__(self, console: Console | None = None) -> None:
        """Takes the console to write to; stderr by default."""
        self.console = console or Console(stderr=True, highlight=False)
        if self.console.width < (1 if self.console.is_terminal else _WIDTH):
            self.console.width = _WIDTH  # COLUMNS=0 would leave nothing of a plan
        self._live: Live | None = None
        self._shown: dict[str, tuple[int, ...]] = {}
        self._last: dict[str, float] = {}
        self._next = float("-inf")

    def show_plan(
        self,
        plan: Plan,
        store: ArtifactStore,
        slots: int,
        found: Audit | None = None,
        device: str = "cpu",
    ) -> float:
        """Prints the number of nodes per component, what is finished, and an estimate.

        Args:
            plan: The plan.
            store: Where finished nodes lie.
            slots: Number of groups that run at once.
            found: What the plan finds there, if that is known.
            device: Where groups run, "cpu" or "cuda".

        Returns:
            The estimate, in seconds.
        """
        found = found or audit(plan, store)
        done = found.finished
        pending = [node.key for node in plan if node.key not in done]
        groups = form_groups(plan, pending, store, slots)
        run_state = RunState(plan, groups, store, slots, done, device)
        table = Table(box=None, pad_edge=False)
        table.add_column("component")
        for name in ("nodes", "finished", "to do", "begun", "task calls", "work"):
            table.add_column(name, justify="right")
        for component, nodes in plan.by_component().items():
            open_nodes = [node for node in nodes if node.key not in done]
            calls = [group for group in groups if group.component == component]
            table.add_row(
                _label(component),
                str(len(nodes)),
                str(len(nodes) - len(open_nodes)),
                str(len(open_nodes)),
                _begun(*run_state.begun(component)),
                str(len(calls)),
                duration(sum(run_state.costs.seconds(c.nodes) for c in calls)) if calls else "",
            )
        self.console.print(table)
        total = max(run_state.remaining().values(), default=0.0)
        number, part = run_state.begun()
        begun = f", {number} of them begun ({part:.0%})" if number else ""
        self.console.print(
            f"{len(pending)} of {len(plan)} nodes to do{begun}, about {duration(total)} "
            f"with {slots} at once ({run_state.costs.source})."
            if pending
            else f"All {len(plan)} nodes are finished."
        )
        if found.unsealed:
            self.note(
                f"{found.unsealed} finished artifacts carry no digests and cannot be checked; "
                "`python -m flows.verify --seal` records them."
            )
        if found.other_code:
            kinds = ", ".join(f"{kind} ({count})" for kind, count in found.other_code.items())
            self.note(
                f"Made by other code of the same version, and used all the same: {kinds}. If the "
                "change can change results, raise the version in the code: they are made again."
            )
        return total

    def start(self, run_state: RunState) -> None:
        """Starts the display of a run."""
        self._shown = {}
        self._last = {}
        if self.console.is_terminal:
            self._live = Live(
                self._table(run_state.components()), console=self.console, auto_refresh=False
            )
            self._live.start(refresh=True)

    def update(self, run_state: RunState) -> None:
        """Shows the present state, unless that was done a moment ago."""
        now = time.monotonic()
        if now < self._next:
            return
        states = run_state.components()
        if self._live is not None:
            self._live.update(self._table(states), refresh=True)
        else:
            for state in states:
                self._log(state)
        done = time.monotonic()
        self._next = done + max(_REDRAW, _SHARE * (done - now))

    def note(self, text: str) -> None:
        """Prints a message, above the lines that stay in place."""
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def stop(self, run_state: RunState) -> None:
        """Shows the last state and ends the display."""
        if self._live is not None:
            self._live.update(self._table(run_state.components()), refresh=True)
            self._live.stop()
            self._live = None
            return
        for state in run_state.components():
            self._log(state, force=True)

    def _log(self, state: ComponentState, *, force: bool = False) -> None:
        counts = (state.done, state.failed, state.skipped)
        now = time.monotonic()
        silent = now - self._last.get(state.component, float("-inf"))
        alive = bool(state.running) and silent >= _SIGN_OF_LIFE
        same = self._shown.get(state.component, (state.reused, 0, 0) if not force else ()) == counts
        if same and not alive:
            return
        if silent < _BETWEEN and not (force or state.over):
            return
        self._shown[state.component] = counts
        self._last[state.component] = now
        words = [f"{_label(state.component)}: {_counts(state)}", _rate(state), _remaining(state)]
        self.console.print(", ".join(word for word in words if word), markup=False, soft_wrap=True)

    def _table(self, states: list[ComponentState]) -> Table:
        table = Table(box=None, pad_edge=False, show_header=False, padding=(0, 1))
        for state in states:
            table.add_row(
                _label(state.component),
                ProgressBar(total=1.0, completed=1.0 if state.over else state.fraction, width=24),
                _counts(state),
                _rate(state),
                _remaining(state),
            )
        return table


def _label(component: str) -> str:
    return component.replace("_", " ")


def _begun(number: int, part: float) -> str:
    return f"{number}, {part:.0%}" if number else ""


def _counts(state: ComponentState) -> str:
    extras = [
        f"{number} {word}"
        for number, word in (
            (state.reused, "reused"),
            (state.running, "running"),
            (state.begun, "begun"),
            (state.failed, "failed"),
            (state.skipped, "skipped"),
        )
        if number
    ]
    part = f" {state.fraction:.0%}" if state.running or state.begun else ""
    return f"{state.done}/{state.total}{part}" + (f" ({', '.join(extras)})" if extras else "")


def _rate(state: ComponentState) -> str:
    if state.per_minute is None:
        return ""
    digits = 0 if state.per_minute >= 10 else 1
    return f"{state.per_minute:.{digits}f}/min"


def _remaining(state: ComponentState) -> str:
    if state.over:
        return "" if state.failed or state.skipped else "done"
    return f"{duration(state.remaining)} left" if state.remaining is not None else ""
