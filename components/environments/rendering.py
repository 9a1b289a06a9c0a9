"""Pictures of a robot under a policy, drawn without a screen.

MuJoCo draws through EGL (a driver, or Mesa in software) or through OSMesa. Which of them works is
found out by trying, in a separate process because a process keeps the first library it has loaded.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from components.environments.frame_history import FrameHistory
from components.environments.systems import drawable_systems

__all__ = ["DRAWABLE", "Camera", "Take", "drawing_library", "film", "pictures_per_second"]

DRAWABLE: Final = drawable_systems()
"""Gymnasium ids of the systems that can be drawn."""
_PICTURES: Final = 25  # wanted per simulated second; robots make 20, 25 or 125 steps

_LIBRARIES: Final = {
    "egl": ("EGL", "libegl1 and libgl1-mesa-dri"),
    "osmesa": ("OSMesa", "libosmesa6"),
}
"""What the libraries that need no screen are called, and the packages that they come in."""
_CHOICE: Final = "MUJOCO_GL"


@dataclass(frozen=True)
class Take:
    """A filmed episode.

    Attributes:
        steps: of the robot.
        seconds: of simulated time.
        fell: whether a fall ended it.
        reward: sum over the steps, undiscounted.
    """

    steps: int
    seconds: float
    fell: bool
    reward: float


def drawing_library() -> str:
    """The library that draws without a screen here: the one MUJOCO_GL names, or the first to work.

    Raises:
        OSError: none works.
    """
    named = os.environ.get(_CHOICE, "").strip().lower()
    for library in (named,) if named else _LIBRARIES:
        if library in _LIBRARIES and _works(library):
            return library
    if named in _LIBRARIES:
        library, packages = _LIBRARIES[named]
        raise OSError(
            f"{_CHOICE}={named} cannot draw here, since the library {library} is missing or "
            f"broken; install it (on Debian: {packages}), or {_otherwise(named)}."
        )
    if named:
        raise OSError(
            f"{_CHOICE}={named} cannot draw without a screen, as {' and '.join(_LIBRARIES)} do; "
            f"{_otherwise(named)}."
        )
    raise OSError(
        "Nothing here can draw without a screen: neither EGL nor OSMesa works; install one of them "
        f"(on Debian: {', or '.join(packages for _, packages in _LIBRARIES.values())})."
    )


def _otherwise(named: str) -> str:
    others = " or ".join(library for library in _LIBRARIES if library != named)
    return f"unset it to use whatever works, or set it to {others}"


def _works(library: str) -> bool:
    attempt = f"from mujoco.{library} import GLContext; GLContext(8, 8).make_current()"
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    done = subprocess.run(
        [sys.executable, "-c", attempt],
        env=environment | {_CHOICE: library},
        capture_output=True,
        check=False,
    )
    return done.returncode == 0


class Camera:
    """Pictures of a robot that is simulated elsewhere; all from one thread.

    Args:
        environment: Gymnasium id, one of `DRAWABLE`.
        parameters: of the environment, such as the physics.
        size: of a picture, in pixels.

    Raises:
        OSError: nothing here can draw without a screen.
    """

    def __init__(self, environment: str, parameters: Mapping[str, Any], size: int = 320) -> None:
        os.environ[_CHOICE] = drawing_library()
        self._robot = gym.make(
            environment,
            disable_env_checker=True,
            render_mode="rgb_array",
            camera_name="track",
            width=size,
            height=size,
            **parameters,
        )
        self._robot.reset(seed=0)

    def picture(
        self, positions: NDArray[np.float64], velocities: NDArray[np.float64]
    ) -> NDArray[np.uint8]:
        """The robot in a state, `[size, size, 3]`.

        Args:
            positions: `[nq]`.
            velocities: `[nv]`.

        Raises:
            OSError: the drawing library fails.
        """
        robot: Any = self._robot.unwrapped
        robot.set_state(positions, velocities)
        return _picture(self._robot)

    def close(self) -> None:
        """Give the drawing library's context back."""
        self._robot.close()


def pictures_per_second(environment: str, parameters: Mapping[str, Any]) -> float:
    """How many pictures of a system :func:`film` draws per simulated second."""
    robot = gym.make(environment, disable_env_checker=True, **parameters)
    steps = _steps_per_second(robot)
    robot.close()
    return steps / _steps_per_picture(steps)


def _steps_per_second(robot: gym.Env[Any, Any]) -> int:
    return int(robot.unwrapped.metadata["render_fps"])


def _steps_per_picture(per_second: int) -> int:
    return max(1, per_second // _PICTURES)


def film(
    environment: str,
    parameters: Mapping[str, Any],
    act: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    draw: Callable[[NDArray[np.uint8]], object],
    *,
    history: int = 1,
    steps: int = 1000,
    seed: int = 0,
    size: int = 480,
) -> Take:
    """Film one episode, until the robot falls or the steps are over.

    Args:
        environment: Gymnasium id, one of `DRAWABLE`.
        parameters: of the environment, such as the physics.
        act: maps frames `[1, H, F]`, newest first, to an action `[A]`.
        draw: called with each picture `[size, size, 3]` in turn.
        history: frames that `act` sees, H.
        steps: at most.
        seed: of the start.
        size: of a picture, in pixels.

    Raises:
        ValueError: a system that cannot be drawn.
        OSError: nothing here can draw without a screen.
    """
    if environment not in DRAWABLE:
        raise ValueError(f"{environment} cannot be drawn; what can be are {', '.join(DRAWABLE)}.")
    os.environ[_CHOICE] = drawing_library()
    robot = gym.make(
        environment,
        max_episode_steps=steps,
        disable_env_checker=True,
        render_mode="rgb_array",
        camera_name="track",
        width=size,
        height=size,
        **parameters,
    )
    try:
        per_second = _steps_per_second(robot)
        every = _steps_per_picture(per_second)
        frame, _ = robot.reset(seed=seed)
        frames, taken, reward = FrameHistory(frame[None], history), 0, 0.0
        draw(_picture(robot))
        fell = ended = False
        while not ended:
            frame, step_reward, fell, truncated, _ = robot.step(act(frames.window))
            frames.push(frame[None])
            taken, reward, ended = taken + 1, reward + float(step_reward), fell or truncated
            if ended or taken % every == 0:
                draw(_picture(robot))
    finally:
        robot.close()
    return Take(taken, taken / per_second, fell, reward)


def _picture(robot: gym.Env[Any, Any]) -> NDArray[np.uint8]:
    """What the camera sees; the first call makes the drawing library's context.

    Raises:
        OSError: the library fails.
    """
    try:
        return np.asarray(robot.render(), dtype=np.uint8)
    except Exception as error:  # MuJoCo, Gymnasium and PyOpenGL have errors of their own
        library = os.environ[_CHOICE]
        raise OSError(
            f"{_CHOICE}={library} cannot draw such a picture here ({error}); try a smaller one, "
            f"or {_otherwise(library)}."
        ) from error
