"""Signals that end a sweep, sent to this process."""

import os
import signal
from collections.abc import Iterator

import pytest

from flows.pipeline.signals import deferred_signals, ending_signals, exit_code, ignored_signals

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """As a terminal starts a process; a background job would ignore Ctrl-C."""
    former = {number: signal.signal(number, signal.default_int_handler) for number in ENDING}
    yield
    for number, handler in former.items():
        assert signal.getsignal(number) is signal.default_int_handler
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_each_is_an_interrupt_with_its_own_exit_code(number: int, code: int) -> None:
    with pytest.raises(KeyboardInterrupt), ending_signals():
        os.kill(os.getpid(), number)
    assert exit_code() == code


def test_the_first_one_decides_and_a_second_one_changes_nothing() -> None:
    with ending_signals():
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGHUP)
        with pytest.raises(KeyboardInterrupt):  # a person who presses it again means it
            signal.raise_signal(signal.SIGINT)
        with ignored_signals():
            signal.raise_signal(signal.SIGINT)
    assert exit_code() == 143


def test_what_a_start_must_not_meet_acts_after_it() -> None:
    done = []

    def start() -> None:
        with deferred_signals():
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGINT)
            done.append("the whole block")

    with ending_signals(), pytest.raises(KeyboardInterrupt):
        start()
    assert done
    assert exit_code() == 143


def test_a_signal_during_a_start_that_fails_still_counts() -> None:
    def start() -> None:
        with deferred_signals():
            signal.raise_signal(signal.SIGTERM)
            raise ValueError

    with ending_signals(), pytest.raises(KeyboardInterrupt):
        start()


def test_what_was_ignored_stays_ignored() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with ending_signals():
        with deferred_signals():
            signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    signal.signal(signal.SIGHUP, signal.default_int_handler)


def test_a_closed_terminal_takes_no_more_output() -> None:
    ours, theirs = os.openpty()
    kept = os.dup(2)
    os.dup2(theirs, 2)
    os.close(theirs)
    try:
        with ending_signals():
            os.close(ours)  # from here on every line there is an error
            with pytest.raises(OSError, match="Input/output error"):
                os.write(2, b"lost")
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGHUP)
            os.write(2, b"no error")
    finally:
        os.dup2(kept, 2)
        os.close(kept)
