"""Files that are not what was written: sizes and digests, and one error that names the file.

A small file is hashed whenever it is checked, a large one once per process: it is hashed again only
if its size, its time of change or its place on the disk is another one.
"""

import hashlib
import json
import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

__all__ = [
    "SMALL",
    "DamagedFileError",
    "MissingFileError",
    "check_file",
    "check_files",
    "damaged_path",
    "describe_files",
    "load_json",
]

SMALL: Final = 64 * 1024
"""Bytes up to which a file is hashed at every check."""

_SIZE: Final = "size"
_SHA256: Final = "sha256"
_known: dict[tuple[str, int, int, int], str] = {}  # digests of large files seen by this process


class DamagedFileError(ValueError):
    """A file is not what was written.

    Args:
        sentence: What is wrong; it names the file.
        path: The file, or the folder.
        remedy: What to do about it; added to the message.

    Attributes:
        sentence: As given, without a full stop.
        path: As given.
    """

    def __init__(self, sentence: str, path: Path | None = None, remedy: str = "") -> None:
        self.sentence, self.path, self._remedy = sentence.rstrip("."), path, remedy
        super().__init__(f"{self.sentence}; {remedy}." if remedy else f"{self.sentence}.")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.sentence, self.path, self._remedy)


class MissingFileError(DamagedFileError, FileNotFoundError):
    """A file that should be there is not."""


def damaged_path(error: BaseException) -> Path | None:
    """The file that an error calls damaged or missing; None if the error is about no such thing."""
    if isinstance(error, DamagedFileError):
        return error.path
    misplaced = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
    if isinstance(error, misplaced) and error.filename is not None:
        return Path(os.fsdecode(error.filename))
    return None


def describe_files(folder: Path, *, leave_out: Collection[str] = ()) -> dict[str, dict[str, Any]]:
    """Size and digest of all files below a folder.

    Args:
        folder: The folder.
        leave_out: Names, relative to the folder.

    Returns:
        Per file, named relative to the folder, its `size` in bytes and its `sha256`.
    """
    files = {}
    for place, _, names in os.walk(folder):
        for path in (Path(place) / name for name in names):
            name = path.relative_to(folder).as_posix()
            if name not in leave_out:
                status = path.stat()
                files[name] = {_SIZE: status.st_size, _SHA256: _sha256(path, status)}
    return dict(sorted(files.items()))


def check_file(
    path: Path,
    expected: Mapping[str, Any],
    *,
    large: bool = True,
    fresh: bool = False,
    remedy: str = "",
) -> None:
    """Compare a file with its description.

    Args:
        path: The file.
        expected: What :func:`describe_files` said of it.
        large: Whether a large file is hashed, too; otherwise only its size is compared.
        fresh: Whether a large file is hashed even if this process has done so before.
        remedy: For the message.

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: It has another size or another digest.
    """
    with _reading(path, remedy):
        status = path.stat()
        if status.st_size != expected[_SIZE]:
            said = f"{path} is damaged (it has {status.st_size} bytes, not {expected[_SIZE]})"
            raise DamagedFileError(said, path, remedy)
        if (large or status.st_size <= SMALL) and (
            _sha256(path, status, fresh=fresh) != expected[_SHA256]
        ):
            said = f"{path} is damaged (its content is not what was written)"
            raise DamagedFileError(said, path, remedy)


def check_files(
    folder: Path,
    files: Mapping[str, Mapping[str, Any]],
    names: Collection[str] | None = None,
    *,
    large: bool = True,
    fresh: bool = False,
    remedy: str = "",
) -> None:
    """Compare the files of a folder with their descriptions; further files are ignored.

    Args:
        folder: The folder.
        files: What :func:`describe_files` said of it.
        names: The files to check; those that were not described are ignored. None: all.
        large: See :func:`check_file`.
        fresh: See :func:`check_file`.
        remedy: For the message.

    Raises:
        DamagedFileError: A file is missing or damaged.
    """
    for name, expected in files.items():
        if names is None or name in names:
            check_file(folder / name, expected, large=large, fresh=fresh, remedy=remedy)


def load_json(path: Path, remedy: str = "", *, exact: bool = False) -> Any:
    """The value in a JSON file.

    Args:
        path: The file.
        remedy: For the message.
        exact: Whether fractions must be written as Python writes them, so that no other text has
            the same value: a last digit that has changed may be lost in reading.

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: It cannot be read, or is not JSON.
    """
    with _reading(path, remedy):
        content = path.read_bytes()
    try:
        return json.loads(content, parse_float=_exact if exact else None)
    except _InexactError as error:
        said = f"{path} is damaged (its content is not what was written)"
        raise DamagedFileError(said, path, remedy) from error
    except ValueError as error:
        raise DamagedFileError(f"{path} is damaged (it is not JSON)", path, remedy) from error


def _exact(text: str) -> float:
    value = float(text)
    if repr(value) != text:
        raise _InexactError
    return value


class _InexactError(ValueError):
    """A fraction is not written as Python writes it."""


@contextmanager
def _reading(path: Path, remedy: str) -> Iterator[None]:
    """Turn what the disk says about a file into an error that names it."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError) as error:
        raise MissingFileError(f"{path} is missing", path, remedy) from error
    except OSError as error:
        raise DamagedFileError(f"{path} cannot be read ({error.strerror})", path, remedy) from error


def _sha256(path: Path, status: os.stat_result, *, fresh: bool = False) -> str:
    if status.st_size <= SMALL:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    identity = (str(path.absolute()), status.st_ino, status.st_size, status.st_mtime_ns)
    if fresh or identity not in _known:
        with path.open("rb") as file:
            _known[identity] = hashlib.file_digest(file, "sha256").hexdigest()
    return _known[identity]
