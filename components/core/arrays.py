"""Arrays in .npz files."""

import zipfile
import zlib
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from components.core.integrity import DamagedFileError, MissingFileError

__all__ = ["load_arrays"]


class _Arrays(dict[str, npt.NDArray[Any]]):
    """The arrays of a file; asking for one that is not there names the file."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path

    def __missing__(self, name: str) -> NoReturn:
        raise DamagedFileError(f"{self._path} lacks {name!r}", self._path)


def load_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """All arrays of an .npz file, read without unpickling.

    Raises:
        MissingFileError: There is no such file.
        DamagedFileError: It cannot be read; also later, if an array is asked for that it lacks.
    """
    found = _Arrays(path)
    try:
        with np.load(path, allow_pickle=False) as arrays:
            found.update({name: arrays[name] for name in arrays.files})
    except FileNotFoundError as error:
        raise MissingFileError(f"{path} is missing", path) from error
    except (ValueError, EOFError, OSError, zipfile.BadZipFile, zlib.error) as error:
        raise DamagedFileError(f"{path} is damaged ({error})", path) from error
    return found
