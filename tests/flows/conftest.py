"""What tests begin with: an empty store, a folder in which toys count, a project of one's own."""

from pathlib import Path

import pytest

from flows.pipeline.store import ArtifactStore


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """The folder in which toys count their executions."""
    (tmp_path / "log").mkdir()
    return tmp_path / "log"


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    """An empty store."""
    return ArtifactStore(tmp_path / "mlruns")


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project folder with an empty conf/dataset, which is the working folder, too."""
    from matplotlib.figure import Figure

    from flows import import_log  # imports PyTorch, which tests of pipelines do without
    from flows.configuration import files

    (tmp_path / "conf" / "dataset").mkdir(parents=True)
    monkeypatch.setattr(files, "CONF", tmp_path / "conf")
    # Drawing is slow.
    monkeypatch.setattr(import_log, "report_figure", lambda dataset: Figure((1, 1)))
    monkeypatch.chdir(tmp_path)
    return tmp_path
