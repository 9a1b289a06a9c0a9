"""Ray's own processes on this computer: where they listen, where their files lie, if they live.

Their folder is ours alone and short, because Ray puts sockets into it whose paths may have 107
bytes. A lock in it, which the kernel releases when the driver dies, tells whether it is still used:
the folder of a killed driver is removed at the next start.
"""

import contextlib
import os
import secrets
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from flows.pipeline.errors import PipelineError
from flows.pipeline.locks import Lock

__all__ = ["LocalRay", "set_environment"]

_PREFIX = "pbray-"
# A socket's path has at most 107 bytes; behind the folder come our name and Ray's own:
# /pbray-12345678/session_2026-01-01_00-00-00_000000_1234567/sockets/plasma_store
_LONGEST = 107 - 80
_OBJECT_STORE_BYTES = 200 * 2**20  # results are a few keys; artifacts go through the disk
_VITAL = ("gcs_server", "raylet")


def set_environment(*, local: bool) -> None:
    """Sets what Ray reads when it is imported; what the user has set stays."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_task_oom_retries", "1")
    if not local:
        return
    # By default Ray listens on every interface. On Windows and macOS it stays on the loopback one
    # unless this asks for more; asked for less, it does so on Linux as well.
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    # A fresh secret per run: works with a home folder that cannot be written, and prints nothing.
    if "RAY_AUTH_MODE" not in os.environ and "RAY_AUTH_TOKEN" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(16)


class LocalRay:
    """Ray on this computer, for one driver."""

    def __init__(self, cpus: int) -> None:
        """Makes the folder, and removes those of drivers that were killed.

        Args:
            cpus: Processors that Ray may use.

        Raises:
            PipelineError: there is no place for temporary files.
        """
        base = _temporary_folder()
        _remove_dead(base)
        made = Path(tempfile.mkdtemp(prefix=f".{_PREFIX}", dir=base))  # for our user alone
        self._lock = Lock(made / "lock", keep=True)
        self._lock.acquire()
        self._folder = made.rename(made.with_name(made.name.removeprefix(".")))
        self.options: dict[str, Any] = {
            "address": "local",
            "include_dashboard": False,
            "num_cpus": cpus,
            "object_store_memory": _OBJECT_STORE_BYTES,
            "_temp_dir": str(self._folder),
        }

    def lost(self, ray: Any, patience: float = 0.0) -> str:
        """Which vital process of Ray has ended, as words; empty while all live.

        Args:
            ray: The module.
            patience: Seconds to wait for the end of one that may be dying just now.
        """
        for name, process in _processes(ray):
            if name in _VITAL:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=patience)
                    return f"its process {name} has ended"
        return ""

    def kill(self, ray: Any) -> None:
        """Ends what is left of Ray after a vital process has died."""
        for _, process in _processes(ray):
            with contextlib.suppress(OSError):
                process.kill()

    def close(self) -> None:
        """Removes the folder."""
        shutil.rmtree(self._folder, ignore_errors=True)
        self._lock.release()


def _processes(ray: Any) -> list[tuple[str, "subprocess.Popen[bytes]"]]:
    # Not public. Should Ray rename it, dead processes are noticed by dead tasks alone.
    node = getattr(ray._private.worker, "_global_node", None)
    known = getattr(node, "all_processes", {})
    return [(name, info.process) for name, infos in known.items() for info in infos]


def _temporary_folder() -> Path:
    """The folder for temporary files, or /tmp if its path is too long for sockets."""
    named = next((name for name in ("RAY_TMPDIR", "TMPDIR") if os.environ.get(name)), None)
    folder = Path(os.environ[named] if named else tempfile.gettempdir()).absolute()
    if not _writable(folder):
        raise PipelineError(
            f"{named or 'The folder for temporary files'}={folder} is no folder that can be "
            f"written: make it, or {'unset' if named else 'set'} {named or 'TMPDIR'}."
        )
    if len(os.fsencode(folder)) <= _LONGEST:
        return folder
    short = Path("/tmp")
    if not _writable(short):
        raise PipelineError(
            f"{named or 'The folder for temporary files'}={folder} is too long for the sockets of "
            f"Ray: set RAY_TMPDIR to a writable folder with at most {_LONGEST} letters."
        )
    return short


def _writable(folder: Path) -> bool:
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def _remove_dead(base: Path) -> None:
    for folder in base.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            lock = Lock(folder / "lock", keep=True)
            if lock.acquire(wait=False):
                shutil.rmtree(folder, ignore_errors=True)
                lock.release()
