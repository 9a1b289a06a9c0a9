"""Kills the driver of a search at many points, and continues each time. Run by test_search.

python -m tests.flows.tuning.crash_points calls|disk FOLDER

For each point a child is forked that kills itself with SIGKILL there; a second child then gives the
same search its trials. What went wrong is printed, one line per problem, and at last the number of
points.
"""

import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flows.pipeline.group import GroupCall
from flows.tuning.study import Study, has_ended
from tests.flows.pipeline.crash_points import die_at_change, in_child
from tests.flows.pipeline.toys import counted
from tests.flows.tuning.toys import run, study

TRIALS, STEPS = 3, 6
Arm = Callable[[Path, Path], None]


def die_in(owner: Any, name: str, after: bool = False) -> Arm:
    """SIGKILL in front of a call, or right after it."""

    def arm(home: Path, log: Path) -> None:
        original = getattr(owner, name)

        def call(*args: Any, **kwargs: Any) -> None:
            if after:
                original(*args, **kwargs)
            os.kill(os.getpid(), signal.SIGKILL)

        setattr(owner, name, call)

    return arm


def die_at_step(step: int) -> Arm:
    """SIGKILL in the middle of a fit."""
    return lambda home, log: (log / f"die-{step}").touch()


CALLS = {
    "in front of ask": die_in(Study, "ask"),
    "after ask": die_in(Study, "ask", after=True),
    "in front of submitting": die_in(GroupCall, "of"),
    "at the first step of a fit": die_at_step(0),
    "in the middle of a fit": die_at_step(3),
    "after a fit, in front of tell": die_in(Study, "complete"),
    "after tell": die_in(Study, "complete", after=True),
}


def problems(home: Path, log: Path) -> list[str]:
    """What is wrong with a study that was interrupted and continued."""
    made = study(home, log, steps=STEPS)
    ended = [trial for trial in made.trials() if has_ended(trial)]
    keys = [trial.user_attrs["key"] for trial in ended]
    found = []
    if len(ended) != TRIALS or made.ended != TRIALS:
        found.append(f"{len(ended)} trials")
    if len(set(keys)) != TRIALS:
        found.append("duplicates")
    if made.start_trial() is None or not has_ended(made.start_trial()):
        found.append("the start is lost")
    if any(not trial.state.is_finished() for trial in made.trials()):
        found.append("open trials")
    if len(made.trials()) > TRIALS + 1:
        found.append("more than one trial was lost")
    # Killed after its last step but in front of its artifact, a fit ends twice.
    if any(counted(log, f"finished-{key}") not in (1, 2) for key in keys):
        found.append("fits were lost or repeated")
    if sum(counted(log, f"finished-{key}") for key in keys) > TRIALS + 1:
        found.append("fits were repeated")
    if any((home / "work").iterdir()) or any((home / "progress").iterdir()):
        found.append("leftovers")
    return found


def check(folder: Path, name: str, arm: Arm) -> bool:
    """One point; whether the first child was killed there."""
    home, log = folder / "mlruns", folder / "log"
    log.mkdir(parents=True)

    def first() -> bool:
        arm(home, log)
        return run(home, log, TRIALS, steps=STEPS).exit_code == 0

    status = in_child(first)
    second = in_child(lambda: run(home, log, TRIALS, steps=STEPS).exit_code == 0)
    found = problems(home, log)
    if status not in (0, -9) or second != 0:
        found.append(f"statuses {status}, {second}")
    for problem in found:
        sys.stdout.write(f"{name}: {problem}\n")
    shutil.rmtree(folder)
    return status == -9


def main(what: str, folder: Path) -> int:
    """Goes through all points."""
    number = 0
    if what == "calls":
        for name, arm in CALLS.items():
            number += check(folder / str(len(name)), name, arm)
    else:
        while check(
            folder / "point",
            f"point {number + 1}",
            lambda home, log, point=number + 1: die_at_change(point, home),
        ):
            number += 1
    sys.stdout.write(f"points: {number}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2])))
