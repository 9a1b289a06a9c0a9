"""Open the MLflow UI on this project's runs: ``python -m flows.ui [--port 5000]``.

The server listens on 127.0.0.1 only. MLflow itself would ignore MLFLOW_TRACKING_URI here and start
on an empty database of its own.
"""

import argparse
import signal
import sys
from typing import Any

from flows.pipeline.errors import TrackingError
from flows.pipeline.remote.places import copy_of, is_address
from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_setup import LEADERBOARD
from flows.pipeline.tracking.mlflow_ui import (
    DEFAULT_PORT,
    UiServer,
    runs_address,
    view_addresses,
)
from flows.pipeline.tracking.redaction import without_secrets


def main() -> None:
    """Serve until the server ends, Ctrl-C or a signal; exit 2 for bad input, 1 for failure."""
    parser = argparse.ArgumentParser(prog="flows.ui", description="Open the MLflow UI.")
    parser.add_argument("--store", default="mlruns", help="folder of the runs")
    parser.add_argument("--port", default=DEFAULT_PORT, type=_port, help="1 to 65535")
    arguments = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the server has to be ended, too
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda received, _: sys.exit(128 + received))
    try:
        given = arguments.store
        address = StoreAddress(copy_of(given) if is_address(given) else given)
        if address.tracking.startswith(("http://", "https://")):
            server = without_secrets(address.tracking)
            print(f"MLFLOW_TRACKING_URI names a server; open {server} in a browser.")
            return
        if address.own and not address.database.is_file():
            parser.error(
                f"{address.root} holds no runs of MLflow; name their folder with --store FOLDER, "
                "or make some first: python -m flows.full_benchmark profile=quick"
            )
        _serve(address, arguments.port)
    except (TrackingError, ValueError) as error:
        print(f"ui: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


def _serve(address: StoreAddress, port: int) -> None:
    experiment, leaderboard = _experiments(address)
    with UiServer(address, port, experiment) as server:
        for line in _links(port, experiment, leaderboard):
            print(line)
        print("Ctrl-C ends the server.", flush=True)
        code = server.wait()
    raise TrackingError(f"The MLflow server ended by itself with exit code {code}.")


def _experiments(address: StoreAddress) -> tuple[Any, Any]:
    """Those of the runs and of the leaderboard; None for one that is not there or not ours."""
    if not address.own:
        return None, None
    # Opening our own store follows a move, and closes what killed sweeps left open.
    runs = MlflowExperiment(address.root, "flows.ui")
    with runs.as_tracking_errors():
        there = runs.client.get_experiment_by_name(LEADERBOARD) is not None
    board = MlflowExperiment(address.root, "flows.ui", LEADERBOARD).entity() if there else None
    return runs.entity(), board


def _links(port: int, experiment: Any, leaderboard: Any) -> list[str]:
    lines = [f"Runs: {runs_address(port, experiment)}"]
    if leaderboard is not None:
        lines.append(f"Leaderboard: {runs_address(port, leaderboard)}")
    views: dict[str, str] = {}
    for shown in (leaderboard, experiment):
        views |= {} if shown is None else view_addresses(port, shown)
    return [*lines, *(f"  {name}: {link}" for name, link in views.items())]


def _port(text: str) -> int:
    """A port's number.

    Raises:
        argparse.ArgumentTypeError: It is none.
    """
    if text.isascii() and text.isdigit() and 1 <= int(text[:6]) <= 65535:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text} is no port; give a number from 1 to 65535.")


if __name__ == "__main__":
    main()
