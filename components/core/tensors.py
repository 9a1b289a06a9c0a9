"""Tensors on disk: safetensors files, written atomically and read without unpickling.

A file vouches for itself: its header holds a digest of all that is in it. Files of older versions
have none and are read as they are.
"""

import errno
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NoReturn

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from components.core.files import replacing
from components.core.integrity import DamagedFileError, MissingFileError

__all__ = ["load_tensors", "save_tensors"]

_HEADER: Final = "verified"
"""The only metadata of a file: safetensors writes several in an order of chance."""
_FORMER_HEADER: Final = "header"  # of files without a digest
_DIGEST: Final = "sha256"


class _Tensors(dict[str, Tensor]):
    """The tensors of a file; asking for one that is not there names the file."""

    def __init__(self, path: Path, tensors: Mapping[str, Tensor]) -> None:
        super().__init__(tensors)
        self._path = path

    def __missing__(self, name: str) -> NoReturn:
        raise DamagedFileError(f"{self._path} lacks {name!r}", self._path)


def save_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write tensors and a JSON header to ``path``, to survive a power cut.

    Raises:
        OSError: If the disk is full or the folder cannot be written.
    """
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    values = json.loads(json.dumps(header))
    text = json.dumps({**values, _DIGEST: _digest(contiguous, values)})
    with replacing(path, durable=True) as temporary:
        temporary.touch()
        mode = temporary.stat().st_mode
        try:
            save_file(contiguous, temporary, metadata={_HEADER: text})
        except SafetensorError as error:
            full = f"os error {errno.ENOSPC}" in str(error)
            raise OSError(errno.ENOSPC if full else errno.EIO, str(error), str(path)) from error
        temporary.chmod(mode)  # safetensors makes files that only their owner may read


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what :func:`save_tensors` wrote.

    Raises:
        MissingFileError: If there is no such file.
        DamagedFileError: If the file is no safetensors file, lacks its header, or is not what was
            written; also later, if a tensor is asked for that it does not hold.
    """
    if not path.is_file():
        raise MissingFileError(f"{path} does not exist", path)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            header = json.loads(metadata.get(_HEADER) or metadata[_FORMER_HEADER])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if _HEADER in metadata and header.pop(_DIGEST) != _digest(tensors, header):
            said = f"{path} is damaged (its content is not what was written)"
            raise DamagedFileError(said, path)
    except (SafetensorError, KeyError, AttributeError, json.JSONDecodeError) as error:
        said = f"{path} is damaged or was not written by this project ({error})"
        raise DamagedFileError(said, path) from error
    return _Tensors(path, tensors), header


def _digest(tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> str:
    """SHA-256 over the header and every tensor's name, type, shape and bytes."""
    digest = hashlib.sha256(json.dumps(header).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()
