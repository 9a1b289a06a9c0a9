"""The doors: ``python -m flows.NAME``. Wiring only; the science is in ``components``.

In: settings of ``conf/`` and the command line. Out: a store of artifacts, their record, reports.
Between them: ``configuration`` reads settings, ``planning`` makes plans of them, ``pipeline``
computes plans with the functions of ``tasks``, ``report`` shows the results; ``tuning`` searches
settings of models.

Every door and every worker imports this package before anything heavy. The import sets what native
libraries read once: one thread per process unless a task asks for more (two processes with
two spinning OpenMP threads each on two cores run a hundred times slower than one), and no
telemetry. A command is also interrupted here without a traceback as long as it imports; once it has
begun, its door handles Ctrl-C (`pipeline.signals`).
"""

import gc
import os
import signal
import sys
from types import FrameType

for _name, _value in {
    "OMP_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "PASSIVE",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "RAY_USAGE_STATS_ENABLED": "0",
}.items():
    os.environ.setdefault(_name, _value)


def _leave(number: int, frame: FrameType | None) -> None:
    os.write(2, b"\nInterrupted before anything had begun.\n")
    os._exit(128 + number)  # an exception could be caught by whatever is being imported


def leave_quietly() -> None:
    """Lets Ctrl-C end a command that still imports, without a traceback."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


# A command of ours is being looked for: `python -m` has this argument meanwhile.
if sys.argv[:1] == ["-m"] and f" -m {__name__}." in " ".join(sys.orig_argv):
    leave_quietly()
    # What a command imports and plans lives as long as it does: looking through it for garbage
    # after every 700 new objects is a tenth of the time in which a finished sweep is looked at.
    gc.set_threshold(50_000, 20, 20)
