"""Writes films, of robots and of figures."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np

from components.core.files import replacing

__all__ = ["video"]


@contextmanager
def video(path: Path, per_second: float) -> Iterator[Callable[[np.ndarray], object]]:
    """A file that takes pictures; it appears under its name when it is whole.

    Args:
        path: Ends in .mp4 or .gif; a GIF is shown for ever.
        per_second: Pictures shown in a second.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {"fps": per_second}
    if path.suffix.lower() == ".gif":
        options = {"duration": 1000 / per_second, "loop": 0}  # milliseconds; for ever
    with replacing(path) as temporary, imageio.get_writer(temporary, **options) as writer:
        yield writer.append_data
