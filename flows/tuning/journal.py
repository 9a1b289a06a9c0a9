"""The file that holds all studies of a store: Optuna's journal, a line of JSON per change.

Optuna passes over a last line that it cannot read, and fails at it as soon as another one follows;
so every line is looked at before a study is opened.
"""

import json
import warnings
from pathlib import Path

import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.storages.journal import JournalFileBackend, JournalStorage

from flows.pipeline.errors import PipelineError
from flows.pipeline.json_lines import mend_last_line
from flows.pipeline.locks import Lock

__all__ = ["journal_path", "open_journal"]

_BEGIN = b'{"op_code":'  # of every line that Optuna writes


def journal_path(store: Path) -> Path:
    """Where a store's journal lies; ``optuna-dashboard PATH`` shows it.

    Args:
        store: Its folder.
    """
    return store.absolute() / "optuna" / "journal.log"


def open_journal(path: Path) -> JournalStorage:
    """Open the file that holds all studies; made if missing.

    A last line that a killed process left incomplete is removed: it is half of one change, of
    which no one was told yet.

    Args:
        path: See :func:`journal_path`.

    Raises:
        PipelineError: The file is damaged, or no journal; it is left as it is.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = Lock(path.with_name(f".{path.name}.lock"), keep=True)
    lock.acquire()
    try:
        _check(path)
        mend_last_line(path)
    finally:
        lock.release()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        try:
            return JournalStorage(JournalFileBackend(str(path), lock))
        except (AssertionError, LookupError, TypeError, ValueError, AttributeError) as error:
            raise PipelineError(
                f"The journal {path} holds what is none of Optuna's changes "
                f"({type(error).__name__}: {error}): set it aside (mv {path.name} "
                f"{path.stem}-damaged.log, in its folder) and give the same command again; "
                "finished fits are found in the store and not made again."
            ) from None


def _check(path: Path) -> None:
    """Looks at every line that is whole, and at the beginning of one that is not.

    Raises:
        PipelineError: One is not a change of a study.
    """
    if not path.exists():
        return
    *whole, rest = path.read_bytes().split(b"\n")
    for number, text in enumerate(whole, start=1):
        try:
            change = json.loads(text)
        except (ValueError, RecursionError):
            change = None
        if not isinstance(change, dict) or not {"op_code", "worker_id"} <= change.keys():
            raise _damaged(path, number)
    if not rest.startswith(_BEGIN[: len(rest)]):
        raise _damaged(path, len(whole) + 1)


def _damaged(path: Path, line: int) -> PipelineError:
    aside = f"{path.stem}-damaged{path.suffix}"
    before = line - 1
    keep = f"; `head -n {before} {aside} > {path.name}` keeps the {before} lines before it"
    return PipelineError(
        f"Line {line} of the journal {path} is damaged: set the file aside (mv {path.name} {aside},"
        f" in its folder{keep if before else ''}) and give the same command again; finished fits "
        "are found in the store and not made again."
    )
