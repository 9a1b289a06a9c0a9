"""What tests of pipelines begin with: an empty store, and a folder in which toys count."""

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
