"""The objects of a shared store, by name: a thin layer over fsspec, with errors in one sentence.

A name such as `nodes/KEY/node.json` is relative to the store's URL. What is written appears whole
or not at all: object stores do so by themselves, elsewhere a temporary name is renamed.
"""

import contextlib
import os
import secrets
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from flows.pipeline.errors import StoreError
from flows.pipeline.tracking.redaction import without_secrets

__all__ = ["Objects"]

_LOCAL = ("file", "local")
_IN_PLACE = (*_LOCAL, "sftp", "ssh", "smb")  # protocols that show half-written files
_HALF = ".half-"  # begins the name of one
_WAITS = (1.0, 3.0, 9.0, 27.0)  # seconds before another try; object stores are away now and then
Result = TypeVar("Result")


class Objects:
    """The objects below a URL."""

    def __init__(self, url: str, pause: Callable[[float], None] = time.sleep) -> None:
        """Prepares access; nothing is asked yet.

        Args:
            url: That fsspec understands, e.g. `s3://bucket/prefix` or `file:///shared/folder`.
            pause: Waits so many seconds.

        Raises:
            StoreError: the protocol is unknown or its package is not installed.
        """
        self.url = url.rstrip("/")
        self._pause = pause
        import fsspec

        protocol = url.partition("://")[0]
        options: dict[str, Any] = {"use_listings_cache": False}  # others write, too
        if protocol in _LOCAL:
            options = {"auto_mkdir": True}
        try:
            self._fs, root = fsspec.url_to_fs(self.url, **options)
        except (ImportError, ValueError) as error:
            raise StoreError(
                f"store={url} cannot be used ({_line(error)}): install what fsspec needs for "
                f"{protocol}:// (s3 comes with `pip install 'proximity-bench[s3]'`) or choose "
                "another address."
            ) from error
        self._root = root.rstrip("/")
        self._renames = protocol in _IN_PLACE
        self._links = protocol in _LOCAL

    def read(self, name: str) -> bytes | None:
        """The content of an object; None if there is none.

        Raises:
            StoreError: the store does not answer.
        """

        def once() -> bytes | None:
            try:
                return bytes(self._fs.cat_file(self._path(name)))
            except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
                return None

        return self._patiently(once)

    def read_many(self, names: Collection[str]) -> dict[str, bytes]:
        """The contents of those that are there.

        Raises:
            StoreError: the store does not answer.
        """
        paths = {self._path(name): name for name in names}

        def once() -> dict[str, bytes]:
            found = self._fs.cat(list(paths), on_error="return") if paths else {}
            contents = {}
            for path, content in found.items():
                if isinstance(content, bytes):
                    contents[paths[path]] = content
                elif not isinstance(content, FileNotFoundError | NotADirectoryError):
                    raise content
            return contents

        if len(paths) == 1:  # for which fsspec answers in another shape
            (name,) = names
            content = self.read(name)
            return {} if content is None else {name: content}
        return self._patiently(once)

    def write(self, name: str, content: bytes) -> None:
        """Writes an object, in place of an earlier one.

        Raises:
            StoreError: the store does not answer, or cannot be written.
        """

        def once() -> None:
            if not self._renames:
                self._fs.pipe_file(self._path(name), content)
                return
            with self._renamed(name) as half:
                self._fs.pipe_file(half, content)

        self._patiently(once)

    def create(self, name: str, content: bytes) -> bool:
        """Writes an object unless there is one of this name; of two writers one succeeds.

        Returns:
            Whether it was written.

        Raises:
            StoreError: the store does not answer, or cannot be written.
        """
        path = self._path(name)

        def once() -> bool:
            try:
                if self._links:
                    self._link(name, content)
                    return True
                if self._renames:
                    self._fs.makedirs(path.rpartition("/")[0], exist_ok=True)
                self._fs.pipe_file(path, content, mode="create")
            except FileExistsError:
                # Also our own, if an earlier try succeeded and its answer was lost.
                return self.read(name) == content
            return True

        return self._patiently(once)

    def _link(self, name: str, content: bytes) -> None:
        """Writes a file of a local disk unless it is there.

        A second name for a whole file: fsspec would look first whether there is one and then write
        in place, so that two succeed at once and a third reads an empty file.

        Raises:
            FileExistsError: it is there.
        """
        path = self._path(name)
        folder, _, last = path.rpartition("/")
        os.makedirs(folder, exist_ok=True)
        half = f"{folder}/{_HALF}{last}-{secrets.token_hex(4)}"
        try:
            with open(half, "xb") as file:
                file.write(content)
            try:
                os.link(half, path)
            except FileExistsError:
                raise
            except OSError:  # a disk without second names
                with open(path, "xb") as file:
                    file.write(content)
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(half)

    def delete(self, names: Iterable[str]) -> None:
        """Removes objects; those that are not there do not matter.

        Raises:
            StoreError: the store does not answer, or cannot be written.
        """
        for name in names:
            path = self._path(name)

            def once(path: str = path) -> None:
                with contextlib.suppress(FileNotFoundError):
                    self._fs.rm_file(path)

            self._patiently(once)

    def sizes(self, prefix: str) -> dict[str, int]:
        """Names and sizes in bytes of the objects below a folder.

        Raises:
            StoreError: the store does not answer.
        """

        def once() -> dict[str, int]:
            try:
                found = self._fs.find(self._path(prefix), detail=True)
            except (FileNotFoundError, NotADirectoryError):
                return {}
            cut = len(self._root) + 1
            return {
                path[cut:]: int(about["size"] or 0)
                for path, about in found.items()
                # A name that leads out of the store would lead out of its copy, too.
                if ".." not in path.split("/") and not path.rpartition("/")[2].startswith(_HALF)
            }

        return self._patiently(once)

    def upload(self, files: Mapping[str, Path]) -> None:
        """Writes objects from files; each is whole only when all are there.

        Raises:
            StoreError: the store does not answer, or cannot be written.
        """
        paths = [self._path(name) for name in files]
        if self._renames:
            for folder in {path.rpartition("/")[0] for path in paths}:
                self._fs.makedirs(folder, exist_ok=True)
        if files:
            self._patiently(lambda: self._fs.put([str(f) for f in files.values()], paths))

    def download(self, files: Mapping[str, Path]) -> bool:
        """Writes objects into files, whose folders are made.

        Returns:
            Whether all of them were there.

        Raises:
            StoreError: the store does not answer.
        """
        for file in files.values():
            file.parent.mkdir(parents=True, exist_ok=True)
        paths = [self._path(name) for name in files]

        def once() -> bool:
            try:
                self._fs.get(paths, [str(file) for file in files.values()])
            except (FileNotFoundError, NotADirectoryError):
                return False
            return True

        return self._patiently(once) if files else True

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}"

    @contextmanager
    def _renamed(self, name: str) -> Iterator[str]:
        path = self._path(name)
        folder, _, last = path.rpartition("/")
        half = f"{folder}/{_HALF}{last}-{secrets.token_hex(4)}"
        self._fs.makedirs(folder, exist_ok=True)
        yield half
        if self._links:
            os.replace(half, path)
        else:
            self._fs.mv(half, path)

    def _patiently(self, once: Callable[[], Result]) -> Result:
        """Tries again where that may help."""
        for wait in (*_WAITS, None):
            try:
                return once()
            except StoreError:
                raise
            except PermissionError as error:
                raise self._refusal(error) from None
            except Exception as error:  # of any kind, fsspec's and its packages'
                if wait is None or _is_final(error):
                    raise self._refusal(error) from None
                self._pause(wait)
        raise AssertionError  # the last wait is None

    def _refusal(self, error: Exception) -> StoreError:
        # The cause is left out: its text may hold what a signature is made of.
        return StoreError(
            f"store={without_secrets(self.url)} does not answer as it should "
            f"({without_secrets(_line(error))}): check the address, the network and the "
            "credentials in the environment, and give the same command again."
        )


def _is_final(error: Exception) -> bool:
    """Whether an error stays the same however often it is tried."""
    if isinstance(error, FileNotFoundError | TypeError):
        return True
    name = type(error).__name__
    return "Credentials" in name or "NoSuchBucket" in name


def _line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return (lines[0] if lines else type(error).__name__).rstrip(".")
