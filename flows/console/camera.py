"""Films a robot while it runs, as fast as the drawing library can and no faster than it steps.

A drawing library belongs to one thread, so every camera has its own, which leaves with its window.
"""

import asyncio
import base64
import io
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

import numpy as np
from PIL import Image

from components.environments.rendering import Camera
from flows.console.bench import Bench

__all__ = ["Filming", "filmed"]

_QUALITY = 80  # of a JPEG picture; at 320 pixels about 8 KB


class Filming:
    """The camera of a window.

    Args:
        bench: Whose robot is filmed.
        show: Called, in another thread, with each picture as a data URL.
        fail: Called, in another thread, with a sentence if nothing can be drawn.
    """

    def __init__(
        self, bench: Bench, show: Callable[[str], object], fail: Callable[[str], object]
    ) -> None:
        self._bench, self._show, self._fail = bench, show, fail
        self._thread = ThreadPoolExecutor(1)
        self._camera: Camera | None = None
        self._broken = False
        self._busy: Future[None] | None = None

    def look(self) -> None:
        """Film the present state, unless the camera is busy with an earlier one."""
        if self._broken or (self._busy is not None and not self._busy.done()):
            return
        positions, velocities = self._bench.pose()
        self._busy = self._thread.submit(self._film, positions, velocities)

    def close(self) -> None:
        """End the thread and give the drawing library back."""
        self._broken = True
        with suppress(RuntimeError):
            self._thread.submit(self._end)
        self._thread.shutdown(wait=False)

    def _film(self, positions: np.ndarray, velocities: np.ndarray) -> None:
        try:
            if self._camera is None:
                self._camera = Camera(*self._bench.system)
            picture = self._camera.picture(positions, velocities)
        except (
            Exception
        ) as error:  # MuJoCo, Gymnasium and drawing libraries have errors of their own
            self._broken = True
            self._fail(f"The robot is not drawn: {error}")
            return
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "JPEG", quality=_QUALITY)
        self._show("data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode())

    def _end(self) -> None:
        if self._camera is not None:
            self._camera.close()


def filmed(
    bench: Bench,
    operated: Callable[[], bool],
    show: Callable[[str], None],
    fail: Callable[[str], None],
) -> Filming:
    """A camera for a page: it tells what it has to say in the page's own thread.

    Args:
        bench: Whose robot is filmed.
        operated: Whether it is still on the page; nothing is told of one that has left.
        show: Called with each picture as a data URL.
        fail: Called with a sentence if nothing can be drawn.
    """
    loop = asyncio.get_running_loop()

    def tell(what: Callable[[str], None], text: str) -> None:
        if operated():
            what(text)

    def told(what: Callable[[str], None]) -> Callable[[str], object]:
        return lambda text: loop.call_soon_threadsafe(tell, what, text)

    return Filming(bench, told(show), told(fail))
