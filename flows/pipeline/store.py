"""The store: everything a run leaves on the disk, but the tracker's record and the reports.

ROOT/nodes/KEY/     a finished artifact, see `artifacts`
ROOT/work/GROUP/    checkpoints and half-made outputs of unfinished ones, see `work`
ROOT/damaged/KEY/   what was set aside because it was not what was written
ROOT/progress/      progress reports of running calls, and requests to stop them
ROOT/sweeps/        the plan of every sweep, see `sweep_records`
ROOT/drivers/       what drives them or did so last, see `driver`
ROOT/locks/         one lock per node that is being computed
"""

import errno
import os
from collections.abc import Collection, Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TypeVar

from components.core.files import read_json
from flows.pipeline.errors import StoreError
from flows.pipeline.work import Work, WorkFolders

__all__ = ["ArtifactStore", "Work", "disk_error_message"]

Call = TypeVar("Call")


def disk_error_message(error: BaseException, root: Path) -> str | None:
    """One sentence with the remedy if an error is about the disk, else None."""
    if not isinstance(error, OSError):
        return None
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"The disk that holds {root} is full: free space and give the same command again."
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST):
        return (
            f"The folder {root} cannot be written ({error.strerror}): "
            "make it a writable folder or choose another one."
        )
    return None


class ArtifactStore(WorkFolders):
    """Finished artifacts by key, the work folders of unfinished ones, and what runs report.

    Everything in it is at hand. A :class:`.remote.shared_store.SharedStore` has to bring things and
    to send them, and does so in the methods at the end.

    Attributes:
        refused: Why an artifact must not be used although nothing here says so, a sentence by key.
    """

    def __init__(self, root: Path | str, *, create: bool = True) -> None:
        """Opens a store.

        Args:
            root: Its folder.
            create: Whether to make the folders; False leaves the disk as it is.

        Raises:
            StoreError: the folder cannot be made or written.
        """
        super().__init__(root)
        self._progress = self.root / "progress"
        self.refused: dict[str, str] = {}
        if create:
            try:
                for folder in (self.nodes, self.work, self.locks, self._progress):
                    folder.mkdir(parents=True, exist_ok=True)
                probe = self.locks / f".probe-{os.getpid()}"
                try:
                    probe.write_text("a few bytes, to find a full disk before the work starts\n")
                finally:
                    probe.unlink(missing_ok=True)
            except OSError as error:
                sentence = disk_error_message(error, self.root)
                raise StoreError(sentence or f"{self.root} cannot be used: {error}.") from error

    def progress_file(self, group: str) -> Path:
        """The file in which a running call reports its progress."""
        return self._progress / f"{group}.json"

    def stop_file(self, group: str) -> Path:
        """The file that asks a running call to stop, once it exists."""
        return self._progress / f"{group}.stop"

    def pause_file(self, group: str) -> Path:
        """The file that asks a running call to end at its next checkpoint, once it exists."""
        return self._progress / f"{group}.pause"

    def clear_progress(self, group: str) -> None:
        """Removes a call's report and requests, also a half-written report of a killed call."""
        for half in self._progress.glob(f".{group}.json-*"):
            half.unlink(missing_ok=True)
        self.progress_file(group).unlink(missing_ok=True)
        self.stop_file(group).unlink(missing_ok=True)
        self.pause_file(group).unlink(missing_ok=True)

    def losses(self, group: str) -> list[tuple[float, float]]:
        """Held-out losses that a call has reported, each after its fraction of the budget; NaN for
        those that are not finite.
        """
        value = read_json(self.progress_file(group))
        losses = value.get("losses", ()) if isinstance(value, dict) else ()
        return [(float(f), float("nan" if loss is None else loss)) for f, loss in losses]

    def fraction(self, group: str) -> float | None:
        """The fraction of a call that is done, between 0 and 1; None if it has not begun."""
        value = read_json(self.progress_file(group))
        return float(value["fraction"]) if isinstance(value, dict) else None

    def fetch(self, keys: Iterable[str]) -> None:
        """Brings the finished ones of these artifacts here, where they already are."""

    def begin(self, keys: Collection[str]) -> None:
        """Brings checkpoints of these nodes here, where they already are."""

    def carrying(self, group: str, work: Work) -> AbstractContextManager[None]:
        """Lets others see a running call's progress and checkpoints, which they do anyway."""
        return nullcontext()

    def sent(self, call: Call) -> Call:
        """A group call as a worker can take it, wherever it is."""
        return call

    def folder(self, named: str) -> Path:
        """A folder outside the store, as a group call names it."""
        return Path(named)

    def driven(self, name: str) -> AbstractContextManager[None]:
        """Drives a sweep; on one machine its lock is enough, see `driver`."""
        return nullcontext()

    def send_request(self, sweep: str) -> None:
        """Sends a request to the driver of a sweep to stop, who sees it anyway."""

    def look_again(self) -> None:
        """Brings the records of sweeps here, where they already are."""
