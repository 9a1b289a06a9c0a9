"""The MLflow UI: the command that serves it, and the address of the list of runs in it."""

import sqlite3
import sys
from contextlib import closing
from pathlib import Path

from flows.pipeline.tracking.mlflow_setup import EXPERIMENT

__all__ = ["runs_address", "server_command"]


def server_command(store: str, port: int) -> list[str]:
    """The command line of the MLflow server for a tracking address."""
    return [
        sys.executable,
        *("-m", "mlflow", "ui", "--backend-store-uri", store),
        *("--host", "127.0.0.1", "--port", str(port), "--workers", "1"),
    ]


def runs_address(database: Path, port: int) -> str:
    """The address of the list of runs; MLflow's own start page leads elsewhere."""
    address = f"http://127.0.0.1:{port}"
    with closing(sqlite3.connect(database)) as connection:
        found = connection.execute(
            "select experiment_id from experiments where name = ?", (EXPERIMENT,)
        ).fetchone()
    if found is None:
        return address
    return f"{address}/#/experiments/{found[0]}/runs?workflowType=machine_learning"
