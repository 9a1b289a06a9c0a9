"""Sealed folders: a record beside the files holds their digests, and one of itself.

The record is `node.json`, a JSON object. Its `files` describe all other files of the folder, its
`digest` is the SHA-256 of the canonical JSON of everything else in the record. A record with
neither comes from an older version: what lies beside it is accepted and cannot be checked.

A JSON object that describes no folder may hold a digest of itself, too.
"""

import hashlib
import json
import time
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Final

from components.core.files import write_json
from components.core.integrity import (
    DamagedFileError,
    check_files,
    describe_files,
    load_json,
)

__all__ = [
    "RECORD",
    "REMEDY",
    "check_digest",
    "check_folder",
    "content_digest",
    "is_sealed",
    "manifest_digest",
    "read_record",
    "read_sealed_json",
    "record_digest",
    "seal",
    "with_digest",
]

RECORD: Final = "node.json"
REMEDY: Final = "give the command of its sweep again, which makes it anew"
_FILES: Final = "files"
_DIGEST: Final = "digest"
_SETTLED: Final = 2_000_000_000  # nanoseconds after which a change has another time than the last
_known: dict[Path, tuple[tuple[int, ...], dict[str, Any]]] = {}  # records that were sound


def seal(folder: Path, values: Mapping[str, Any]) -> None:
    """Write the record of a folder whose other files are complete.

    Args:
        folder: The folder.
        values: Content of the record, JSON; digests of an earlier record are replaced.
    """
    kept = {name: value for name, value in values.items() if name not in (_FILES, _DIGEST)}
    # As it will be read: keys become text, tuples become lists.
    record = json.loads(json.dumps(kept)) | {_FILES: describe_files(folder, leave_out=(RECORD,))}
    write_json(folder / RECORD, with_digest(record))


def read_record(folder: Path) -> dict[str, Any]:
    """The record of a folder, which is the caller's to read only.

    It is read once per process, and again only if the size of its file, its time of change or its
    place on the disk is another one.

    Raises:
        MissingFileError: There is none.
        DamagedFileError: It is no JSON object or not what was written.
    """
    path = folder / RECORD
    try:
        status = path.stat()
    except OSError:
        return _read_record(path)  # which says what is wrong
    identity = (status.st_ino, status.st_size, status.st_mtime_ns)
    place = path.absolute()
    known = _known.get(place)
    if known is not None and known[0] == identity:
        return known[1]
    record = _read_record(path)
    if time.time_ns() - status.st_mtime_ns > _SETTLED:
        _known[place] = (identity, record)
    return record


def _read_record(path: Path) -> dict[str, Any]:
    record = load_json(path, REMEDY, exact=True)
    if not isinstance(record, dict):
        raise DamagedFileError(f"{path} is damaged (it is no JSON object)", path, REMEDY)
    if _FILES in record or _DIGEST in record:
        written = record.get(_DIGEST)
        rest = {name: value for name, value in record.items() if name != _DIGEST}
        if _FILES not in record or written != _digest(rest):
            raise DamagedFileError(
                f"{path} is damaged (its content is not what was written)", path, REMEDY
            )
    return record


def is_sealed(record: Mapping[str, Any]) -> bool:
    """Whether a record holds digests."""
    return _FILES in record


def manifest_digest(files: Mapping[str, Mapping[str, Any]]) -> str:
    """A digest of what :func:`~components.core.integrity.describe_files` returned."""
    return _digest(files)


def content_digest(record: Mapping[str, Any]) -> str | None:
    """A digest of all files that a record describes; None for a record of an older version."""
    return manifest_digest(record[_FILES]) if is_sealed(record) else None


def record_digest(record: Mapping[str, Any]) -> str | None:
    """The digest of a record and of all files it describes; None for one of an older version."""
    return str(record[_DIGEST]) if is_sealed(record) else None


def check_folder(
    folder: Path,
    names: Collection[str] | None = None,
    *,
    record: dict[str, Any] | None = None,
    large: bool = True,
    fresh: bool = False,
) -> dict[str, Any]:
    """Check a folder's record and files.

    Args:
        folder: The folder.
        names: The files to check, relative to the folder; None: all.
        record: What :func:`read_record` returned, if it was read before.
        large: Whether large files are hashed, too; otherwise only their sizes are compared.
        fresh: Whether large files are hashed even if this process has done so before.

    Returns:
        The record.

    Raises:
        DamagedFileError: The record or a file is missing or damaged.
    """
    if record is None:
        record = read_record(folder)
    check_files(folder, record.get(_FILES, {}), names, large=large, fresh=fresh, remedy=REMEDY)
    return record


def read_sealed_json(folder: Path, name: str) -> Any:
    """The value in a JSON file of a sealed folder.

    Args:
        folder: The folder.
        name: Of the file, relative to the folder.

    Raises:
        DamagedFileError: The record or the file is missing or damaged.
    """
    check_folder(folder, (name,))
    return load_json(folder / name, REMEDY)


def with_digest(values: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON object with a digest of itself."""
    return {**values, _DIGEST: _digest(values)}


def check_digest(values: dict[str, Any]) -> None:
    """Take the digest from a JSON object; objects of older versions have none.

    Raises:
        ValueError: The object is not what was written.
    """
    written = values.pop(_DIGEST, None)
    if written not in (None, _digest(values)):
        raise ValueError("its content is not what was written")


def _digest(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
