"""Sets MLflow up: no telemetry, a database that is whole, tags that name user and commit."""

import getpass
import logging
import os
import re
import sqlite3
import subprocess
from pathlib import Path
from typing import Any

__all__ = ["EXPERIMENT", "import_mlflow", "make_database", "source_tags", "without_password"]

EXPERIMENT = "proximity-bench"
"""Name of the MLflow experiment that all sweeps share."""


def import_mlflow() -> Any:
    """Imports MLflow without telemetry, printed addresses and long retries."""
    for name, value in {
        "MLFLOW_DISABLE_TELEMETRY": "true",
        "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
        # A server that is gone should be reported in seconds, not after minutes of retries.
        "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
        "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
    }.items():
        os.environ.setdefault(name, value)
    import mlflow

    for name in ("mlflow", "alembic"):
        # What they log as an error they also raise, and it is reported as one sentence.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return mlflow


def make_database(root: Path) -> None:
    """Makes ROOT/mlflow.db with all its tables, in WAL mode, if there is none.

    It grows under another name: a database whose maker was killed halfway stays unusable.
    """
    path = root / "mlflow.db"
    if path.exists():
        return
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    young = root / ".mlflow-young.db"
    for leftover in root.glob(f"{young.name}*"):
        leftover.unlink()
    store = SqlAlchemyStore(f"sqlite:///{young}", (root / "artifacts").as_uri())
    store.engine.dispose()
    connection = sqlite3.connect(young)
    try:
        connection.execute("pragma journal_mode=WAL")
        connection.execute("pragma wal_checkpoint(TRUNCATE)")
    finally:
        connection.close()
    os.replace(young, path)


def source_tags() -> dict[str, str]:
    """Tags that name the user and the commit, as far as they are known."""
    tags = {}
    try:
        tags["mlflow.user"] = getpass.getuser()
    except (KeyError, OSError):
        tags["mlflow.user"] = "unknown"
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        ).stdout.strip()
        tags["mlflow.source.git.commit"] = commit
    except (OSError, subprocess.SubprocessError):
        pass
    return tags


def without_password(uri: str) -> str:
    """An address without the password in it."""
    return re.sub(r"//[^/@]*@", "//", uri)
