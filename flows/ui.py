"""Open the MLflow UI on this project's runs: ``python -m flows.ui [--port 5000]``.

The server listens on 127.0.0.1 only. MLflow itself would ignore MLFLOW_TRACKING_URI here and start
on an empty database of its own.
"""

import argparse
import os
from pathlib import Path

from flows.pipeline.tracking.mlflow_setup import make_database
from flows.pipeline.tracking.mlflow_ui import runs_address, server_command


def main() -> None:
    """Replace this process by the server."""
    parser = argparse.ArgumentParser(prog="flows.ui", description="Open the MLflow UI.")
    parser.add_argument("--store", default="mlruns", help="folder of the runs")
    parser.add_argument("--port", default=5000, type=int)
    arguments = parser.parse_args()
    uri = os.environ.get("MLFLOW_TRACKING_URI", "")
    if uri.startswith(("http://", "https://")):
        print(f"MLFLOW_TRACKING_URI names a server; open {uri} in a browser.")
        return
    if not uri:
        root = Path(arguments.store).absolute()
        root.mkdir(parents=True, exist_ok=True)
        make_database(root)
        uri = f"sqlite:///{root}/mlflow.db"
        address = runs_address(root / "mlflow.db", arguments.port)
    else:
        address = f"http://127.0.0.1:{arguments.port}"
    os.environ["MLFLOW_SERVER_ENABLE_JOB_EXECUTION"] = "false"
    print(f"Runs: {address}\nThe server needs some seconds to start; Ctrl-C ends it.", flush=True)
    command = server_command(uri, arguments.port)
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
