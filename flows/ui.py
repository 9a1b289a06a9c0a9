"""Open the MLflow UI on this project's runs: ``python -m flows.ui [--port 5000]``.

The server listens on 127.0.0.1 only. MLflow itself would ignore MLFLOW_TRACKING_URI here and start
on an empty database of its own.
"""

import argparse
import signal
import sys

from flows.pipeline.errors import TrackingError
from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.pipeline.tracking.mlflow_ui import UiServer, runs_address
from flows.pipeline.tracking.redaction import without_secrets


def main() -> None:
    """Serve until the server ends, Ctrl-C or a signal; exit 2 for bad input, 1 for failure."""
    parser = argparse.ArgumentParser(prog="flows.ui", description="Open the MLflow UI.")
    parser.add_argument("--store", default="mlruns", help="folder of the runs")
    parser.add_argument("--port", default=5000, type=_port, help="1 to 65535")
    arguments = parser.parse_args()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda received, _: sys.exit(128 + received))
    try:
        address = StoreAddress(arguments.store)
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
    except TrackingError as error:
        print(f"ui: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


def _serve(address: StoreAddress, port: int) -> None:
    # Opening our own store follows a move, and closes what killed sweeps left open.
    experiment = MlflowExperiment(address.root, "flows.ui").entity() if address.own else None
    with UiServer(address, port, experiment) as server:
        print(f"Runs: {runs_address(port, experiment)}\nCtrl-C ends the server.", flush=True)
        code = server.wait()
    raise TrackingError(f"The MLflow server ended by itself with exit code {code}.")


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
