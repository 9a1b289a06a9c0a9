"""Signals that end a sweep: Ctrl-C, SIGTERM from a batch system or a container, a closed terminal.

Each becomes a KeyboardInterrupt in the main thread, so that whatever handles Ctrl-C handles all of
them; only the exit code tells which it was.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

__all__ = ["deferred_signals", "ending_signals", "exit_code", "ignored_signals"]

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

Handler = Callable[[int, FrameType | None], Any] | int | None


_came: list[int] = []  # kept here: Ray turns whatever a handler raises into a plain interrupt


def exit_code() -> int:
    """Exit code after an interrupt: 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP."""
    return 128 + (_came[0] if _came else signal.SIGINT)


@contextmanager
def ending_signals() -> Iterator[None]:
    """Raises a KeyboardInterrupt at the first SIGTERM or SIGHUP, and at every Ctrl-C.

    The second SIGTERM or SIGHUP changes nothing: by then the process is tidying up. What was
    ignored before, as under `nohup`, stays ignored.
    """
    terminals = [number for number in (1, 2) if os.isatty(number)]
    _came.clear()

    def end(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP:
            _leave(terminals)
        first = not _came
        _came.append(number)
        if first or number == signal.SIGINT:
            raise KeyboardInterrupt

    with _handled_by(end):
        yield


@contextmanager
def deferred_signals() -> Iterator[None]:
    """Lets a block finish that an interrupt would break; a signal that came meanwhile acts then."""
    came: list[int] = []
    try:
        with _handled_by(lambda number, frame: came.append(number)):
            yield
    finally:
        if came:
            signal.raise_signal(came[0])


@contextmanager
def ignored_signals() -> Iterator[None]:
    """Ignores the signals, so that tidying up finishes."""
    with _handled_by(signal.SIG_IGN):
        yield


@contextmanager
def _handled_by(handler: Handler) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = {
        number: signal.signal(number, handler)
        for number in _ENDING
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, earlier in former.items():
            signal.signal(number, earlier)


def _leave(terminals: list[int]) -> None:
    """Turns output away from a terminal that is gone: every line there would be an error."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in terminals:
        os.dup2(nowhere, number)
    os.close(nowhere)
