"""A store that was moved or copied: its database is told where its files are now.

MLflow remembers for every experiment and run an absolute address of its files. At a new place these
lead to the old one: to nothing, or, from a copy, into the original.
"""

import sqlite3
from contextlib import closing
from pathlib import Path

from flows.pipeline.tracking.mlflow_address import StoreAddress, path_of

__all__ = ["follow_move", "former_place"]

_PLACES = (
    ("experiments", "artifact_location"),
    ("runs", "artifact_uri"),
    ("logged_models", "artifact_location"),
    ("model_versions", "source"),
    ("model_versions", "storage_location"),
    ("trace_tags", "value"),
)
"""Tables and columns with addresses of files."""
_WAIT = 20.0  # seconds for another program that writes


def former_place(database: Path) -> str | None:
    """Where the files of a store lay when MLflow last looked; None if that cannot be said.

    That is the folder above the default experiment's, which is made with the database and which no
    one gives another place.

    Args:
        database: The store's own one.

    Raises:
        sqlite3.Error: It is damaged, locked or no database of MLflow.
    """
    with closing(sqlite3.connect(database, timeout=_WAIT)) as connection:
        found = connection.execute(
            "select artifact_location from experiments where experiment_id = 0"
        ).fetchone()
    if found is None or not str(found[0]).endswith("/artifacts/0"):
        return None
    return str(found[0]).removesuffix("/0")


def follow_move(address: StoreAddress, former: str | None) -> str:
    """Rewrites addresses of files in the store's database, if they are those of another place.

    The caller keeps other processes away. Either all addresses are rewritten or none.

    Args:
        address: Of the store; it has a database of its own.
        former: See `former_place`.

    Returns:
        A sentence about what was done; empty if the store is where it was.

    Raises:
        sqlite3.Error: The database cannot be used.
    """
    if former is None or address.artifacts is None or former == address.artifacts:
        return ""
    old, new = path_of(former), path_of(address.artifacts)
    if old is None or new is None or (old.exists() and new.exists() and old.samefile(new)):
        return ""  # elsewhere on purpose, or another name of the same folder
    with closing(sqlite3.connect(address.database, timeout=_WAIT)) as connection, connection:
        there = {name for (name,) in connection.execute("select name from sqlite_master")}
        for table, column in _PLACES:
            if table in there:
                _rewrite(connection, table, column, former, address.artifacts)
    return f"This store was moved or copied from {old.parent}: MLflow now finds its files here."


def _rewrite(connection: sqlite3.Connection, table: str, column: str, old: str, new: str) -> None:
    connection.execute(
        f"update {table} set {column} = :new || substr({column}, length(:old) + 1) "
        f"where {column} = :old or substr({column}, 1, length(:old) + 1) = :old || '/'",
        {"old": old, "new": new},
    )
