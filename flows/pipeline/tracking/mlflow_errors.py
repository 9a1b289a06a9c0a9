"""Says in one sentence why MLflow refused and what to do."""

import re
from pathlib import Path

from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.redaction import without_secrets

__all__ = ["refusal"]

_SAFE = "artifacts on disk are safe"
_AGAIN = "give the same command again"
_SCHEMA = re.compile(r"found version (\w+), but expected (\w+)")


def refusal(error: Exception, address: StoreAddress) -> str:
    """One sentence about an error of MLflow, its database or its server; without secrets.

    Args:
        error: What was raised.
        address: Of the store.
    """
    text = str(error).strip()
    if address.own:
        sentence = _of_our_database(text, address)
        if sentence:
            return sentence
    line = next(iter(text.splitlines()), "") or type(error).__name__
    line = without_secrets(line)[:300].rstrip(".")
    where = str(address.database) if address.own else without_secrets(address.tracking)
    return (
        f"MLflow at {where} refused ({line}); {_SAFE}: repair it, or set MLFLOW_TRACKING_URI to "
        f"another one, and {_AGAIN}."
    )


def _of_our_database(text: str, address: StoreAddress) -> str:
    database = address.database
    if re.search("not a database|malformed|no such table: (experiments|alembic)", text):
        return (
            f"MLflow's database {database} is damaged; {_SAFE}: set it aside (mkdir damaged; mv "
            f"{database.name}* damaged/, in its folder) and {_AGAIN}, which records all nodes anew."
        )
    if "database is locked" in text:
        return (
            f"Another program holds MLflow's database {database} locked; {_SAFE}: end that program "
            f"(fuser {database.name} names it), and {_AGAIN}."
        )
    if re.search("readonly database|read-only|unable to open database", text):
        return (
            f"MLflow's database {database} cannot be written; {_SAFE}: get the right to write it "
            f"and its folder, or copy the store to a disk of yours, and {_AGAIN}."
        )
    if "database or disk is full" in text:
        return (
            f"MLflow's database {database} cannot grow, the disk is full; {_SAFE}: "
            f"make room, and {_AGAIN}."
        )
    found = _SCHEMA.search(text) or re.search("Can't locate revision.*'(\\w+)'", text)
    return _of_another_version(found.group(1), address) if found else ""


def _of_another_version(revision: str, address: StoreAddress) -> str:
    import mlflow.store.db_migrations as migrations

    known = Path(next(iter(migrations.__path__))) / "versions"
    if not list(known.glob(f"{revision}*.py")):
        return (
            f"A newer MLflow has written the database {address.database}; {_SAFE}: "
            f"update MLflow (pip install --upgrade mlflow), and {_AGAIN}."
        )
    return (
        f"An older MLflow has written the database {address.database}; {_SAFE}: copy it, convert "
        f"it with: mlflow db upgrade '{address.tracking}', and {_AGAIN}."
    )
