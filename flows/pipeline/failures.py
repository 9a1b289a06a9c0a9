"""What is said of a task that has failed."""

import traceback
from pathlib import Path

from components.core.integrity import DamagedFileError
from flows.pipeline.store import disk_error_message

__all__ = ["REPAIR_REMEDY", "failure_reason"]

REPAIR_REMEDY = "runner.repair=recompute has it made again"


def failure_reason(error: BaseException, root: Path) -> str:
    """The traceback of an error and, where there is one, a sentence with the remedy.

    Args:
        error: What a task has raised.
        root: Folder of the store.
    """
    text = "".join(traceback.format_exception(error)).rstrip()
    sentence = disk_error_message(error, root)
    if isinstance(error, DamagedFileError):
        sentence = f"{error.sentence}; {REPAIR_REMEDY}."
    if sentence is None and (
        isinstance(error, MemoryError) or "out of memory" in str(error).lower()
    ):
        sentence = (
            "Memory ran out: lower runner.cpus, so that fewer tasks run at once, or the batch."
        )
    return f"{text}\n{sentence}" if sentence else text
