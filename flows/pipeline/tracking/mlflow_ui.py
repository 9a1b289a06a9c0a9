"""The MLflow server behind the UI: started, asked whether it answers for this store, ended."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from http.client import HTTPConnection, HTTPException
from typing import Any
from urllib.parse import quote

from flows.pipeline.errors import TrackingError
from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_setup import EXPERIMENT
from flows.pipeline.tracking.mlflow_views import saved_views, view_query
from flows.pipeline.tracking.redaction import without_secrets

__all__ = ["DEFAULT_PORT", "UiServer", "runs_address", "sweep_address", "view_addresses"]

_HOST = "127.0.0.1"
DEFAULT_PORT = 5000
"""Of the UI, unless another one is asked for."""
_START = 180.0  # seconds until a server must answer
_END = 10.0  # seconds in which it may end by itself
_PAUSE = 0.2  # seconds between two questions


def runs_address(port: int, experiment: Any) -> str:
    """The address of the list of runs; MLflow's own start page leads elsewhere.

    Args:
        port: Of the server.
        experiment: The store's experiment; None if unknown.
    """
    address = f"http://{_HOST}:{port}"
    if experiment is None:
        return address
    return f"{address}/#/experiments/{experiment.experiment_id}/runs?workflowType=machine_learning"


def sweep_address(experiment: Any, run_id: str | None) -> str:
    """The address of a run: on the user's server, or where `flows.ui` serves the store.

    Args:
        experiment: The MlflowExperiment.
        run_id: Of the run; None for the list of all.
    """
    named = experiment.address.tracking
    remote = named.startswith(("http://", "https://"))
    server = (
        without_secrets(named).partition("?")[0].rstrip("/")
        if remote
        else f"http://{_HOST}:{DEFAULT_PORT}"
    )
    run = "" if run_id is None else f"/{run_id}"
    return f"{server}/#/experiments/{experiment.id}/runs{run}?workflowType=machine_learning"


def view_addresses(port: int, experiment: Any) -> dict[str, str]:
    """The addresses of an experiment's saved views by their names, with their charts.

    Args:
        port: Of the server.
        experiment: As MLflow knows it.
    """
    page = runs_address(port, experiment)
    views = saved_views(experiment.tags)
    return {name: f"{page}&{view_query(key)}" for key, name in views.items()}


class UiServer:
    """An MLflow server on this computer's own address, with all processes that it starts.

    Used as a context: leaving it ends them all.
    """

    def __init__(self, address: StoreAddress, port: int, experiment: Any = None) -> None:
        """Starts nothing yet.

        Args:
            address: Of the store.
            port: To listen on.
            experiment: The store's experiment, as MLflow knows it; None if unknown.
        """
        self._address = address
        self._port = port
        self._experiment = experiment
        self._process: subprocess.Popen[str] | None = None
        self._last: deque[str] = deque(maxlen=50)
        self._ready = False

    def __enter__(self) -> "UiServer":
        """Starts the server and waits until it answers for this store.

        Raises:
            TrackingError: The port is taken, or the server does not answer.
        """
        _check_free(self._port)
        # The address goes by the environment: a list of processes would show a password.
        environment = os.environ | {
            "MLFLOW_BACKEND_STORE_URI": self._address.tracking,
            "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
        }
        self._process = subprocess.Popen(
            _command(self._port),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,  # a group of its own, which is ended as a whole
        )
        threading.Thread(target=self._pass_on, daemon=True).start()
        try:
            self._wait_until_it_answers(self._process)
        except BaseException:
            self.stop()
            raise
        self._ready = True
        return self

    def __exit__(self, *error: object) -> None:
        """Ends the server."""
        self.stop()

    def wait(self) -> int:
        """Waits until the server ends by itself; its exit code."""
        assert self._process is not None
        return self._process.wait()

    def stop(self) -> None:
        """Ends the server and whatever it started; does nothing if none runs."""
        process, self._process = self._process, None
        if process is None:
            return
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_END)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def _pass_on(self) -> None:
        """Keeps what the server says until it answers; passes it on afterwards."""
        process = self._process
        assert process is not None
        assert process.stdout is not None
        for line in process.stdout:
            text = without_secrets(line.rstrip())
            self._last.append(text)
            if self._ready:
                print(text, file=sys.stderr, flush=True)

    def _wait_until_it_answers(self, process: "subprocess.Popen[str]") -> None:
        deadline = time.monotonic() + _START
        while not self._answers():
            if process.poll() is not None or time.monotonic() > deadline:
                said = next((line for line in reversed(self._last) if line.strip()), "nothing")
                raise TrackingError(
                    f"The MLflow server on port {self._port} did not start (it said: {said}); "
                    "look whether `python -m mlflow ui` starts elsewhere, or give another --port."
                )
            threading.Event().wait(_PAUSE)

    def _answers(self) -> bool:
        """Whether MLflow answers, and knows the store's experiment at the store's place."""
        query = f"/api/2.0/mlflow/experiments/get-by-name?experiment_name={quote(EXPERIMENT)}"
        connection = HTTPConnection(_HOST, self._port, timeout=10.0)
        try:
            connection.request("GET", query)
            found = json.loads(connection.getresponse().read())
        except (OSError, HTTPException, ValueError):
            return False
        finally:
            connection.close()
        if not isinstance(found, dict):
            return False
        if self._experiment is None:
            return "experiment" in found or "error_code" in found
        answer = found.get("experiment", {})
        return all(
            answer.get(name) == getattr(self._experiment, name)
            for name in ("experiment_id", "artifact_location")
        )


def _command(port: int) -> list[str]:
    words = ["-m", "mlflow", "ui", "--host", _HOST, "--port", str(port), "--workers", "1"]
    return [sys.executable, *words]


def _check_free(port: int) -> None:
    with socket.socket() as probe:
        # As the server does it: a port that was in use a moment ago is free.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_HOST, port))
        except OSError as error:
            raise TrackingError(
                f"Port {port} of this computer cannot be used ({error.strerror}): another program "
                f"may be listening there; give another one, e.g. --port {_free_port()}."
            ) from None


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_HOST, 0))
        return int(probe.getsockname()[1])
