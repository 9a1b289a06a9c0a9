"""Sets MLflow up: no telemetry, a database that is whole, tags that name user and commit."""

import getpass
import logging
import os
import sqlite3
from contextlib import suppress
from typing import Any

from flows.pipeline.source import commit
from flows.pipeline.tracking.mlflow_address import StoreAddress, sqlite_address

__all__ = [
    "ABOUT",
    "EXPERIMENT",
    "LEADERBOARD",
    "import_mlflow",
    "make_database",
    "source_tags",
]

EXPERIMENT = "proximity-bench"
"""Name of the MLflow experiment that all sweeps share."""

LEADERBOARD = f"{EXPERIMENT} leaderboard"
"""Name of the MLflow experiment with one flat run per result."""

_NOTES = {
    EXPERIMENT: "Everything that was computed: a run per sweep or search, below it one per node "
    "or trial. Saved views (in the menu of this page) list one kind of runs flat, side by side. "
    f"Results are compared in the experiment **{LEADERBOARD}**.",
    LEADERBOARD: "One run per dataset, algorithm and seed, with what its policies achieved in the "
    "real system. Sort by any column, or open a saved view: all algorithms on one dataset, one "
    "algorithm over all datasets, results over the proximity. A run's note leads to the data, the "
    "models and the policy behind it.",
}
ABOUT = {
    name: {"mlflow.experimentKind": "custom_model_development", "mlflow.note.content": note}
    for name, note in _NOTES.items()
}
ABOUT[LEADERBOARD] |= {
    "mlflow.experiment.primaryMetric.name": "return/tenth_percentile",
    "mlflow.experiment.primaryMetric.greaterIsBetter": "True",
}
"""Tags of an experiment by its name: what opens MLflow's view of model training, and a note."""


def import_mlflow() -> Any:
    """Imports MLflow without telemetry, printed addresses, bars and long retries."""
    for name, value in {
        "MLFLOW_DISABLE_TELEMETRY": "true",
        "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
        "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
        # A server that is gone should be reported in seconds, not after minutes of retries.
        "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
        "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
    }.items():
        os.environ.setdefault(name, value)
    import mlflow

    for name in ("mlflow", "alembic", "urllib3"):
        # What they log as an error they also raise, and it is reported as one sentence; what
        # urllib3 logs of a request that failed may hold a token.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return mlflow


def make_database(address: StoreAddress) -> None:
    """Makes the store's database with all its tables, in WAL mode, if there is none.

    It grows under another name: a database whose maker was killed halfway stays unusable.

    Args:
        address: Of the store.
    """
    root, path = address.root, address.database
    if path.exists() and path.stat().st_size:
        return
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    young = root / ".mlflow-young.db"
    for leftover in root.glob(f"{young.name}*"):
        leftover.unlink()
    for end in ("-wal", "-shm"):
        # Changes of a database that was taken away: SQLite would apply them to the new one.
        with suppress(FileNotFoundError):
            path.with_name(path.name + end).rename(path.with_name(f"{path.name}{end}-aside"))
    store = SqlAlchemyStore(sqlite_address(young), address.artifacts)
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
    if found := commit():
        tags["mlflow.source.git.commit"] = found
    return tags
