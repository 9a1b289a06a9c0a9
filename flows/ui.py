"""Open the MLflow UI on this project's runs: ``python -m flows.ui [--port 5000]``.

The server listens on 127.0.0.1 only. MLflow itself would ignore MLFLOW_TRACKING_URI here and start
on an empty database of its own.
"""

import argparse
import os
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

from flows.pipeline.tracking.mlflow_setup import EXPERIMENT, make_database

__all__ = ["runs_address", "server_command"]


def server_command(store: str, port: int) -> list[str]:
    """The MLflow server's command line for a tracking address."""
    return [
        sys.executable,
        *("-m", "mlflow", "ui", "--backend-store-uri", store),
        *("--host", "127.0.0.1", "--port", str(port), "--workers", "1"),
    ]


def runs_address(database: Path, port: int) -> str:
    """Where the list of runs is; MLflow's own start page leads elsewhere."""
    address = f"http://127.0.0.1:{port}"
    with closing(sqlite3.connect(database)) as connection:
        found = connection.execute(
            "select experiment_id from experiments where name = ?", (EXPERIMENT,)
        ).fetchone()
    if found is None:
        return address
    return f"{address}/#/experiments/{found[0]}/runs?workflowType=machine_learning"


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
