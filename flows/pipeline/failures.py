"""What is said of a task that has failed."""

import re
import traceback
from pathlib import Path

from components.core.integrity import DamagedFileError
from flows.pipeline.store import disk_error_message

__all__ = ["REPAIR_REMEDY", "failure_line", "failure_reason", "ran_out_of_memory"]

_NO_MEMORY = ("out of memory", "allocate memory", "alloc_failed")  # of PyTorch and cuBLAS

_RAISED = re.compile(r"[\w.]*(Error|Exception)\b")  # how the last line of a traceback begins
_OWN_FRAME = re.compile(
    r'^ +File ".*?\b((?:components|flows|proximity_bench)/[^"]+)", line (\d+), in (\S+)', re.M
)

REPAIR_REMEDY = "runner.repair=recompute has it made again"


def ran_out_of_memory(error: BaseException) -> bool:
    """Whether a task has asked for more memory than there was, of a GPU or the computer's own."""
    said = str(error).lower()
    return isinstance(error, MemoryError) or any(words in said for words in _NO_MEMORY)


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
    if sentence is None and ran_out_of_memory(error):
        sentence = (
            "Memory ran out: lower runner.cpus, or on a GPU raise runner.gpu_share, so that fewer "
            "tasks run at once, or lower the batch."
        )
    return f"{text}\n{sentence}" if sentence else text


def failure_line(reason: str) -> str:
    """The last line of a reason, with the line of this project's code that an error came from.

    Args:
        reason: A traceback, or one sentence.
    """
    text = reason.strip() or "no reason given"
    last, places = text.splitlines()[-1], _OWN_FRAME.findall(text)
    if not places or not _RAISED.match(last):
        return last
    file, line, function = places[-1]
    return f"{last} ({file}, line {line}, in {function})"
