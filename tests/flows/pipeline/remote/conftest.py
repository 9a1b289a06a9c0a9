"""A real S3 server on 127.0.0.1, and stores of every kind."""

import os
import secrets
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.request import urlopen

import pytest

from flows.pipeline.remote.places import CACHE
from tests.flows.pipeline.toys import wait_for


def _answers(address: str) -> bool:
    try:
        urlopen(address, timeout=5).close()
    except OSError:
        return False
    return True


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


@pytest.fixture(scope="session")
def s3() -> Iterator[dict[str, str]]:
    """The environment that leads to an S3 server of our own."""
    port = free_port()
    address = f"http://127.0.0.1:{port}"
    words = ("-m", "moto.server", "--host", "127.0.0.1", "--port", str(port))
    with subprocess.Popen(
        [sys.executable, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as server:
        wait_for(lambda: _answers(address), "the S3 server")
        yield {
            "AWS_ACCESS_KEY_ID": "tests",
            "AWS_SECRET_ACCESS_KEY": "tests-secret",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": address,
        }
        server.terminate()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """This machine's folder for copies."""
    monkeypatch.setenv(CACHE, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(params=["file", "s3"])
def url(request: pytest.FixtureRequest, tmp_path: Path, cache: Path) -> str:
    """The address of an empty shared store."""
    if request.param == "file":
        return f"file://{tmp_path}/shared"
    return bucket(request.getfixturevalue("s3"), request.getfixturevalue("monkeypatch"))


def bucket(environment: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> str:
    """The address of an empty folder in a new bucket."""
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    import s3fs

    name = f"tests-{secrets.token_hex(6)}"
    s3fs.S3FileSystem(use_listings_cache=False).mkdir(name)
    os.environ.pop("AWS_PROFILE", None)
    return f"s3://{name}/some/prefix"
