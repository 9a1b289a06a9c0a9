"""A Ray cluster that others have started: whether it answers, at the start and later."""

import contextlib
import socket
import time
from typing import Any

from flows.pipeline.errors import PipelineError

__all__ = ["Cluster", "check_address"]

_BETWEEN = 5.0  # seconds between two looks at the head
_SILENCE = 20.0  # seconds without an answer after which it is gone; Ray aborts the driver after 60


class Cluster:
    """The cluster at RAY_ADDRESS."""

    def __init__(self, address: str) -> None:
        """Nothing is asked yet."""
        self.options: dict[str, Any] = {"address": address}
        self._head: tuple[str, int] | None = None
        self._asked = self._answered = float("-inf")

    def lost(self, ray: Any, patience: float = 0.0) -> str:
        """Why the cluster cannot be used any more, as words; empty while it can.

        Args:
            ray: The module, connected.
            patience: Serves another kind of Ray.
        """
        now = time.monotonic()
        if now - self._asked < _BETWEEN:
            return ""
        self._asked = now
        if self._head is None:
            # The first look finds an address that answers; one that never did tells nothing.
            self._head = _head(ray)
            self._answered = now
        if self._head is None or _answers(*self._head, timeout=3.0) is None:
            self._answered = now
        return "" if now - self._answered < _SILENCE else "its head does not answer"

    def kill(self, ray: Any) -> None:
        """Does nothing: its processes belong to others."""

    def close(self) -> None:
        """Does nothing."""


def _head(ray: Any) -> tuple[str, int] | None:
    with contextlib.suppress(Exception):  # not every kind of connection has the address
        host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
        if _answers(host.strip("[]"), int(port), timeout=3.0) is None:
            return host.strip("[]"), int(port)
    return None


def _answers(host: str, port: int, timeout: float) -> OSError | None:
    try:
        socket.create_connection((host, port), timeout=timeout).close()
    except OSError as error:
        return error
    return None


def check_address(address: str) -> None:
    """Finds a wrong address in seconds, where Ray itself would try for minutes.

    Raises:
        PipelineError: nothing listens there.
    """
    host, colon, port = address.rpartition("://")[2].rpartition(":")
    if not colon or not port.isdigit():
        return  # "auto" or a form that only Ray knows
    error = _answers(host.strip("[]"), int(port), timeout=10.0)
    if error is not None:
        raise PipelineError(
            f"Nothing answers at RAY_ADDRESS={address} ({error.strerror or error}): "
            "start the cluster, correct the address, or unset it to use this computer."
        ) from error
