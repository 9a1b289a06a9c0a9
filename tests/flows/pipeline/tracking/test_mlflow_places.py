"""Stores of any name, moved or copied: where MLflow's database and the files of its runs are."""

import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from flows.pipeline.errors import TrackingError
from flows.pipeline.tracking.mlflow_address import StoreAddress, path_of
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from tests.flows.pipeline.tracking.sweeps import run, runs, small

NAMES = ["feature%2Fx", "what?x=y", "my%20run", "a#b", "größe ö;c", "100%", "u:p@host", "q'\"x"]


def addresses(home: Path) -> list[str]:
    """All addresses of files in a store's database."""
    with closing(sqlite3.connect(home / "mlflow.db")) as connection:
        found = connection.execute(
            "select artifact_location from experiments union select artifact_uri from runs"
        )
        return [address for (address,) in found]


def all_files(folder: Path) -> dict[str, bytes]:
    return {str(f): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


def rest(folder: Path) -> None:
    """Writes what SQLite keeps beside the database into it, as the end of a process does."""
    with closing(sqlite3.connect(folder / "mlflow.db")) as connection:
        connection.execute("pragma wal_checkpoint(TRUNCATE)")


@pytest.mark.parametrize("name", NAMES)
def test_an_address_leads_to_its_folder_whatever_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    from sqlalchemy.engine import make_url

    address = StoreAddress(tmp_path / name)
    assert make_url(address.tracking).database == str(tmp_path / name / "mlflow.db")
    assert address.artifacts is not None
    assert path_of(address.artifacts) == tmp_path / name / "artifacts"
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_no_address_can_hold_is_refused_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    with pytest.raises(TrackingError, match=r"folder of the name .*: rename it, choose ano") as e:
        StoreAddress(tmp_path / os.fsdecode(b"r\xff"))
    str(e.value).encode()  # can be printed
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow(2)
@pytest.mark.parametrize("name", ["feature%2Fx", "what?x=y#z", "my%20run ö"])
def test_runs_land_in_their_own_store_and_nowhere_else(
    bare: Path, database: Path, name: str
) -> None:
    # The folder that the unquoted name would mean, as a neighbour with a store of its own.
    home, neighbour = bare.parent / name / "runs", bare.parent / "my run ö" / "runs"
    neighbour.mkdir(parents=True)
    home.mkdir(parents=True)
    shutil.copy(database, home)
    before = sorted(p.name for p in bare.parent.iterdir())
    outcome, tracker = run(home, small(home.parent))
    assert outcome.unrecorded == ""
    assert len(runs(tracker, "node")) == 2
    with closing(sqlite3.connect(home / "mlflow.db")) as connection:
        assert connection.execute("select count(*) from runs").fetchone() == (3,)
    for recorded in runs(tracker, "node"):
        client, run_id = tracker.experiment.client, recorded.info.run_id
        assert "node.json" in [f.path for f in client.list_artifacts(run_id)]
        assert (home / "artifacts" / run_id / "artifacts" / "node.json").is_file()
    assert sorted(p.name for p in bare.parent.iterdir()) == before
    assert list(neighbour.iterdir()) == []


@pytest.mark.slow(2)
def test_a_moved_store_takes_its_addresses_along(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(home, small(home))
    rest(home)
    new = home.parent / "new" / "my runs"
    new.parent.mkdir()
    home.rename(new)
    home.write_text("nothing can be made below the old place")
    capsys.readouterr()
    outcome, tracker = run(new, small(home), "second")
    assert (outcome.unrecorded, len(outcome.reused)) == ("", 2)
    said = capsys.readouterr().err.splitlines()
    assert said == [f"This store was moved or copied from {home}: MLflow now finds its files here."]
    assert {path_of(address).is_relative_to(new / "artifacts") for address in addresses(new)} == {
        True
    }
    for recorded in runs(tracker, "node"):
        listed = tracker.experiment.client.list_artifacts(recorded.info.run_id)
        assert "node.json" in [file.path for file in listed]
    run(new, small(home), "third")
    assert capsys.readouterr().err == ""  # said once


@pytest.mark.slow(2)
def test_a_copy_leaves_the_original_alone(home: Path) -> None:
    run(home, small(home))
    rest(home)
    copy = home.parent / "copy"
    shutil.copytree(home, copy)
    before = all_files(home)
    run(copy, small(home), "second")
    assert all_files(home) == before
    assert {path_of(address).is_relative_to(copy) for address in addresses(copy)} == {True}
    assert {path_of(address).is_relative_to(home) for address in addresses(home)} == {True}


@pytest.mark.slow(1)
def test_another_name_of_the_same_folder_is_no_move(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(home, small(home))
    before = addresses(home)
    link = home.parent / "link"
    link.symlink_to(home)
    capsys.readouterr()
    run(link, small(home), "second")
    assert set(before) < set(addresses(home))
    assert capsys.readouterr().err == ""
    assert StoreAddress(link).root == home


@pytest.mark.slow(1)
def test_files_that_someone_put_elsewhere_stay_there(home: Path) -> None:
    elsewhere = (home.parent / "large disk").as_uri()
    MlflowTracker(home)
    rest(home)
    with closing(sqlite3.connect(home / "mlflow.db")) as connection, connection:
        connection.execute(
            "update experiments set artifact_location = ? where experiment_id != 0", (elsewhere,)
        )
    new = home.rename(home.parent / "new")
    run(new, small(home))
    assert elsewhere in addresses(new)
    assert len(list((home.parent / "large disk").iterdir())) == 3


@pytest.mark.slow(1)
def test_our_own_database_named_in_the_environment_is_our_own(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(home, small(home))
    rest(home)
    new = home.rename(home.parent / "new")
    monkeypatch.chdir(home.parent)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///new/mlflow.db")
    run(new, small(home), "second")
    assert {path_of(address).is_relative_to(new) for address in addresses(new)} == {True}


@pytest.mark.slow(1)
def test_a_database_elsewhere_does_not_write_to_a_place_that_is_gone(
    home: Path, database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(database, home.parent / "other.db")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{home.parent}/other.db")
    run(home, small(home))
    new = home.rename(home.parent / "new")
    with pytest.raises(TrackingError, match=r"keeps the files of all runs in .*my runs/artifacts,"):
        MlflowTracker(new)
    assert not home.exists()
