"""Where MLflow finds a store: the one place that turns its folder into addresses.

A folder may have any name, and an address is not a path: SQLAlchemy and MLflow end it at `?` and
`#` and undo `%20`, each in its own way. So every address is quoted here, and read back with the
functions that MLflow reads it with before it is used.
"""

import os
from pathlib import Path
from urllib.parse import quote, urlparse
from urllib.request import url2pathname

from flows.pipeline.errors import TrackingError

__all__ = ["StoreAddress", "path_of", "sqlite_address"]

_REMOTE = ("http", "https", "databricks")


class StoreAddress:
    """The addresses of a store for MLflow.

    Attributes:
        root: Folder of the store, absolute and without links.
        database: Our own database in it.
        own: Whether that is used; else MLFLOW_TRACKING_URI names another one, or a server.
        tracking: What MLflow is opened with. It may hold a password.
        artifacts: Address of the folder with the runs' files; None if a server chooses it.
    """

    def __init__(self, root: Path | str) -> None:
        """Builds the addresses; touches nothing on disk.

        Args:
            root: Folder of the store.

        Raises:
            TrackingError: No address leads MLflow to a folder of this name.
        """
        self.root = Path(root).resolve()
        self.database = self.root / "mlflow.db"
        named = os.environ.get("MLFLOW_TRACKING_URI", "")
        self.own = not named or _database_of(named) == self.database
        self.tracking = sqlite_address(self.database) if self.own else named
        remote = named.partition(":")[0] in _REMOTE
        self.artifacts = None if remote else _file_address(self.root / "artifacts")


def sqlite_address(database: Path) -> str:
    """The SQLAlchemy address of a database file.

    Args:
        database: Its absolute path.

    Raises:
        TrackingError: None leads to this file.
    """
    from sqlalchemy.engine import make_url

    # From version 2.1 on, SQLAlchemy undoes the quoting. With the driver's name in front, MLflow
    # does not make the folder that the address would name if it were a path.
    for name in (quote(os.fsencode(database)), str(database)):
        address = f"sqlite+pysqlite:///{name}"
        if make_url(address).database == str(database):
            return address
    raise _unusable(database.parent)


def _database_of(address: str) -> Path | None:
    """The file that an address of SQLite leads to; None for any other address."""
    if not address.startswith("sqlite"):
        return None
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        name = make_url(address).database
    except (ArgumentError, ValueError):
        return None
    return Path(name).resolve() if name else None


def _file_address(folder: Path) -> str:
    address = folder.as_uri()
    if path_of(address) != folder:
        raise _unusable(folder.parent)
    return address


def path_of(address: str) -> Path | None:
    """The path that a local address leads to, as MLflow reads it; None for any other."""
    parsed = urlparse(address)
    if parsed.scheme not in ("", "file") or parsed.netloc:
        return None
    return Path(url2pathname(parsed.path))


def _unusable(folder: Path) -> TrackingError:
    name = os.fsencode(folder).decode(errors="replace")
    return TrackingError(
        f"MLflow cannot keep its records in a folder of the name {name}: rename it, choose "
        "another store=FOLDER, or use runner.tracker=file."
    )
