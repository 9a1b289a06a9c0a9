"""What people see: the plan before the work, one line per component during it.

On a terminal the lines stay in place; in a file or a log a line is written when its numbers change,
seldom enough to be read afterwards. Everything goes to stderr.
"""

import time

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from flows.pipeline.plan import Plan
from flows.pipeline.run_state import Line, RunState
from flows.pipeline.schedule import form_groups
from flows.pipeline.store import ArtifactStore

__all__ = ["Display", "duration"]

_SELDOM = 15.0  # seconds between two lines about one component in a log
_SIGN_OF_LIFE = 60.0  # seconds after which a log hears of a component whose numbers stand still


def duration(seconds: float) -> str:
    """A time span for people."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes:02d} min"


class Display:
    """Shows a plan and its progress."""

    def __init__(self, console: Console | None = None) -> None:
        """Takes the console to write to; stderr by default."""
        self.console = console or Console(stderr=True, highlight=False)
        self._live: Live | None = None
        self._shown: dict[str, tuple[int, ...]] = {}
        self._last: dict[str, float] = {}

    def show_plan(self, plan: Plan, store: ArtifactStore, slots: int) -> None:
        """Prints the number of nodes per component, what is finished, and an estimate.

        Args:
            plan: The plan.
            store: Where finished nodes lie.
            slots: Groups that will run at once.
        """
        done = {node.key for node in plan if store.complete(node.key)}
        pending = [node.key for node in plan if node.key not in done]
        groups = form_groups(plan, pending, store)
        run_state = RunState(plan, groups, store, slots, done)
        table = Table(box=None, pad_edge=False)
        table.add_column("component")
        for name in ("nodes", "finished", "to do", "task calls", "work"):
            table.add_column(name, justify="right")
        for component, nodes in plan.by_component().items():
            open_nodes = [node for node in nodes if node.key not in done]
            calls = [group for group in groups if group.component == component]
            table.add_row(
                _label(component),
                str(len(nodes)),
                str(len(nodes) - len(open_nodes)),
                str(len(open_nodes)),
                str(len(calls)),
                duration(run_state.costs.seconds(open_nodes)) if open_nodes else "",
            )
        self.console.print(table)
        total = max(run_state.remaining().values(), default=0.0)
        source = "from measured times" if run_state.costs.measured else "a rough guess"
        self.console.print(
            f"{len(pending)} of {len(plan)} nodes to do, about {duration(total)} "
            f"with {slots} at once ({source})."
            if pending
            else f"All {len(plan)} nodes are finished."
        )

    def start(self, run_state: RunState) -> None:
        """Begins to show a run."""
        self._shown = {}
        self._last = {}
        if self.console.is_terminal:
            self._live = Live(
                self._table(run_state.lines()), console=self.console, auto_refresh=False
            )
            self._live.start(refresh=True)

    def update(self, run_state: RunState) -> None:
        """Shows the present state."""
        lines = run_state.lines()
        if self._live is not None:
            self._live.update(self._table(lines), refresh=True)
        else:
            for line in lines:
                self._log(line)

    def note(self, text: str) -> None:
        """Prints one line for people, above the live lines."""
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def stop(self, run_state: RunState) -> None:
        """Shows the last state and leaves it standing."""
        if self._live is not None:
            self._live.update(self._table(run_state.lines()), refresh=True)
            self._live.stop()
            self._live = None
            return
        for line in run_state.lines():
            self._log(line, force=True)

    def _log(self, line: Line, *, force: bool = False) -> None:
        counts = (line.done, line.failed, line.skipped)
        now = time.monotonic()
        silent = now - self._last.get(line.component, float("-inf"))
        alive = bool(line.running) and silent >= _SIGN_OF_LIFE
        same = self._shown.get(line.component, (line.reused, 0, 0) if not force else ()) == counts
        if same and not alive:
            return
        if silent < _SELDOM and not (force or line.over):
            return
        self._shown[line.component] = counts
        self._last[line.component] = now
        words = [f"{_label(line.component)}: {_counts(line)}", _rate(line), _remaining(line)]
        self.console.print(", ".join(word for word in words if word), markup=False, soft_wrap=True)

    def _table(self, lines: list[Line]) -> Table:
        table = Table(box=None, pad_edge=False, show_header=False, padding=(0, 1))
        for line in lines:
            table.add_row(
                _label(line.component),
                ProgressBar(total=1.0, completed=1.0 if line.over else line.fraction, width=24),
                _counts(line),
                _rate(line),
                _remaining(line),
            )
        return table


def _label(component: str) -> str:
    return component.replace("_", " ")


def _counts(line: Line) -> str:
    extras = [
        f"{number} {word}"
        for number, word in (
            (line.reused, "reused"),
            (line.running, "running"),
            (line.failed, "failed"),
            (line.skipped, "skipped"),
        )
        if number
    ]
    part = f" {line.fraction:.0%}" if line.running else ""
    return f"{line.done}/{line.total}{part}" + (f" ({', '.join(extras)})" if extras else "")


def _rate(line: Line) -> str:
    if line.per_minute is None:
        return ""
    digits = 0 if line.per_minute >= 10 else 1
    return f"{line.per_minute:.{digits}f}/min"


def _remaining(line: Line) -> str:
    if line.over:
        return "" if line.failed or line.skipped else "done"
    return f"{duration(line.remaining)} left" if line.remaining is not None else ""
