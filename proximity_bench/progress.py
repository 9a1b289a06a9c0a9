"""Progress bars of what takes long."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

__all__ = ["Begin", "progress_bars"]

Begin = Callable[[str], Callable[[float], None]]
"""Begins a bar of this name; what it returns is told the finished fraction, 0 to 1."""


@contextmanager
def progress_bars(shown: bool) -> Iterator[Begin]:
    """Bars on standard error, where it is a terminal or a notebook.

    Args:
        shown: Whether there are any.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    silent = not shown or not (console.is_terminal or console.is_jupyter)
    with Progress(*columns, console=console, disable=silent) as bars:

        def begin(name: str) -> Callable[[float], None]:
            task = bars.add_task(name, total=1.0)
            return lambda fraction: bars.update(task, completed=fraction)

        yield begin
