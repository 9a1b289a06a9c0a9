"""What MLflow refuses ends in one sentence, which names its remedy and tells no secret."""

import shutil
import sqlite3
import traceback
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from flows.pipeline.errors import TrackingError
from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_errors import refusal
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from tests.flows.pipeline.toys import node
from tests.flows.pipeline.tracking.sweeps import run, runs, small

pytestmark = pytest.mark.slow(1)


def overwrite(database: Path) -> None:
    database.write_bytes(b"no database at all " * 1000)


def cut(database: Path) -> None:
    database.write_bytes(database.read_bytes()[:9000])


def foreign(database: Path) -> None:
    database.unlink()
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("create table mine (x)")


def version(revision: str) -> Callable[[Path], None]:
    def change(database: Path) -> None:
        with closing(sqlite3.connect(database)) as connection, connection:
            connection.execute("update alembic_version set version_num = ?", (revision,))

    return change


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (overwrite, "is damaged; artifacts on disk are safe: set it aside (mkdir damaged; mv mlfl"),
        (cut, "is damaged; artifacts on disk are safe: set it aside (mkdir damaged; mv mlfl"),
        (foreign, "is damaged; artifacts on disk are safe: set it aside (mkdir damaged; mv mlfl"),
        (version("ffff00001111"), "A newer MLflow has written the database"),
        (version("451aebb31d03"), "it with: mlflow db upgrade 'sqlite+pysqlite:///"),
    ],
    ids=["overwritten", "cut", "foreign", "newer", "older"],
)
def test_a_database_that_cannot_be_used_is_one_sentence(
    home: Path, damage: Callable[[Path], None], says: str
) -> None:
    damage(home / "mlflow.db")
    before = (home / "mlflow.db").read_bytes()
    with pytest.raises(TrackingError) as caught:
        run(home, small(home))
    message = str(caught.value)
    assert says in message
    assert str(home / "mlflow.db") in message
    assert "\n" not in message
    assert message.count(". ") == 0
    assert (home / "mlflow.db").read_bytes() == before


def test_the_remedy_for_a_damaged_database_records_everything_anew(
    home: Path, database: Path
) -> None:
    run(home, small(home))
    again = home.rename(home.parent / "again")  # another name: this process keeps the old one open
    for leftover in again.glob("mlflow.db*"):
        leftover.unlink()
    shutil.copy(database, again)
    outcome, tracker = run(again, small(home), "second")
    assert (len(outcome.reused), len(runs(tracker, "node"))) == (2, 2)


def test_a_locked_database_is_named(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flows.pipeline.tracking.mlflow_moves._WAIT", 0.0)
    with closing(sqlite3.connect(home / "mlflow.db")) as other:
        other.execute("pragma locking_mode=exclusive")
        other.execute("begin exclusive")
        with pytest.raises(TrackingError, match=r"holds MLflow's database .*locked; .*end that pr"):
            MlflowTracker(home)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("(sqlite3.OperationalError) attempt to write a readonly database", "cannot be written;"),
        ("(sqlite3.OperationalError) unable to open database file", "cannot be written;"),
        ("(sqlite3.OperationalError) database or disk is full\n[SQL: x]", "the disk is full;"),
    ],
)
def test_what_the_disk_refuses_is_named(home: Path, text: str, says: str) -> None:
    sentence = refusal(RuntimeError(text), StoreAddress(home))
    assert says in sentence
    assert sentence.endswith("give the same command again.")


@pytest.mark.parametrize(
    "address",
    [
        "http://name:hunter2-secret@127.0.0.1:9",
        "http://name:pa/ss@hunter2-secret@127.0.0.1:9/x",
        "http://127.0.0.1:9/?token=hunter2-secret",
        "http://hunter2-secret@127.0.0.1:9",
        "postgresql://name:hunter2-secret@127.0.0.1:9/x",
        "nonsense://name:hunter2-secret@host",
        "http://[name:hunter2-secret@host",
    ],
)
def test_no_message_tells_a_secret(
    home: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    address: str,
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", address)
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    monkeypatch.setenv("MLFLOW_SQLALCHEMYSTORE_POOL_SIZE", "1")
    monkeypatch.setattr("mlflow.store.db.utils.MAX_RETRY_COUNT", 1)
    with pytest.raises(TrackingError, match="refused") as caught:
        MlflowTracker(home)
    printed = "".join(traceback.format_exception(caught.value))
    out, err = capfd.readouterr()
    for text in (str(caught.value), printed, out, err, caplog.text):
        assert "hunter2" not in text


def test_no_tag_and_no_file_of_a_run_holds_a_secret(
    home: Path, database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(database, home.parent / "other.db")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{home.parent}/other.db")
    monkeypatch.setenv("MLFLOW_TRACKING_TOKEN", "hunter2-secret")
    tracker = MlflowTracker(home, source="http://a:hunter2-secret@b")
    tracker.open("first", {"command": "x uri=http://a:hunter3@b y"})
    toy = node("fails", "bad", home.parent / "log", number=1)
    tracker.log_failure(toy, "Traceback: Bearer hunter2-secret\nOSError: hunter2-secret refused")
    tracker.close("FAILED")
    (parent,), (failed,) = runs(tracker, "sweep"), runs(tracker, "node")
    assert "hunter" not in str(parent.data.tags | failed.data.tags)
    assert parent.data.tags["command"] == "x uri=http://b y"
    assert failed.data.tags["error"] == "OSError: *** refused"
    (text,) = (home / "artifacts").rglob("traceback.txt")
    assert "hunter" not in text.read_text()
