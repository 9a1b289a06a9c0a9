"""How many processors there are, and that no task asks for more."""

import os

from flows.pipeline.errors import PipelineError

__all__ = ["available_cpus", "check_threads"]


def available_cpus() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_threads(threads: int, processors: int) -> None:
    """Refuses a task that would wait for ever for processors, or share them among its threads.

    Args:
        threads: Of a task.
        processors: That it can have.

    Raises:
        PipelineError: there are fewer.
    """
    if threads > processors:
        raise PipelineError(
            f"runner.threads={threads}, but a task can have no more than {processors} of the "
            f"processors: give runner.threads={processors} or less."
        )
