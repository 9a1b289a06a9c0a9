"""How a door begins and ends: help, errors in one sentence, exit codes."""

import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

from flows.configuration.checking import SettingsError
from flows.pipeline.errors import PipelineError
from flows.pipeline.signals import ending_signals, exit_code

__all__ = ["run_door"]

Loaded = TypeVar("Loaded")


def run_door(
    door: str,
    help_text: str,
    load: Callable[[Sequence[str]], Loaded],
    body: Callable[[Loaded], int],
    *,
    resumes: bool = False,
) -> None:
    """Run a door and exit: 2 for bad input, 1 for failure, 130 after Ctrl-C, else 0.

    SIGTERM and SIGHUP end it as Ctrl-C does, with 143 and 129. A sweep that stops as it was asked
    to ends with 75.

    Args:
        door: Its name.
        help_text: Its help.
        load: Makes settings of the words of the command line.
        body: Its work.
        resumes: Whether the same command goes on where an interrupted one has stopped.
    """
    arguments = sys.argv[1:]
    if any(word in ("-h", "--help", "help") for word in arguments):
        print(help_text)
        sys.exit(0)
    try:
        with ending_signals():
            code = body(load(arguments))
    except SettingsError as error:
        print(f"{door}: {error}", file=sys.stderr)
        code = 2
    except (PipelineError, OSError, ValueError) as error:
        print(f"{door}: {error}", file=sys.stderr)
        code = 1
    except KeyboardInterrupt:
        how = "; give the same command again to continue" if resumes else ""
        print(f"{door}: interrupted{how}.", file=sys.stderr)
        code = exit_code()
        _forget_interrupt()
    sys.exit(code)


def _forget_interrupt() -> None:
    """Keeps the exit code of an interrupt that was handled.

    CPython remembers one that has left code executed from a text, as importing a dataclass does,
    and kills itself with SIGINT in the end whatever was done about it. The next text that is
    executed makes it forget.
    """
    exec("")
