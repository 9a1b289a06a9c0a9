"""An empty MLflow database, made once, and stores with a copy of it."""

import shutil
from pathlib import Path

import pytest

from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_setup import import_mlflow, make_database


@pytest.fixture(scope="session")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty database, made once: its sixty migrations take more than a second."""
    address = StoreAddress(tmp_path_factory.mktemp("template"))
    import_mlflow()
    make_database(address)
    return address.database


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is not there yet."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "log").mkdir()
    return tmp_path / "my runs"  # a blank, as in many home folders


@pytest.fixture
def home(bare: Path, database: Path) -> Path:
    """A folder with an empty database."""
    bare.mkdir()
    shutil.copy(database, bare)
    return bare
