"""Films of robots, really drawn where a library can; what is said where none can."""

import os
import subprocess
import sys

import numpy as np
import pytest

from components.environments import INDUSTRIAL_BENCHMARK_ID, rendering
from components.environments.mujoco.specifications import HOPPER, SWIMMER, Robot
from components.environments.rendering import drawing_library, film, pictures_per_second
from components.environments.systems import make_batch


@pytest.fixture(scope="module")
def library() -> str:
    """The library that draws here; tests that need one are skipped where there is none."""
    try:
        return drawing_library()
    except OSError as error:
        pytest.skip(str(error))


@pytest.mark.slow(2)
def test_a_film_shows_the_episode_until_the_fall(
    library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", library)
    pictures: list[np.ndarray] = []
    seen: list[np.ndarray] = []

    def act(frames: np.ndarray) -> np.ndarray:
        seen.append(frames.copy())
        return np.ones(3)

    take = film(HOPPER.id, {"physics": "v3"}, act, pictures.append, history=2, seed=3, size=64)
    robots = make_batch(HOPPER.id, 1)
    frame, total, steps = robots.reset([np.random.default_rng(3)]), 0.0, 0
    np.testing.assert_array_equal(seen[0], np.stack([frame, frame], axis=1))
    while not robots.terminated.any():
        before = frame
        frame, reward = robots.step(np.ones((1, 3)))
        total, steps = total + float(reward[0]), steps + 1
    assert (take.steps, take.fell, take.reward) == (steps, True, total)
    np.testing.assert_array_equal(seen[-1][:, 0], before)
    # a start, every fifth of 125 steps a second, and the fall
    assert take.seconds == steps / 125
    assert len(pictures) == 1 + -(-steps // 5)
    assert all(p.shape == (64, 64, 3) and p.dtype == np.uint8 for p in pictures)
    assert np.std(pictures[0]) > 10, "a picture of something"
    assert (pictures[0] != pictures[-1]).any()


@pytest.mark.slow(2)
def test_a_swimmer_is_filmed_for_as_long_as_asked(
    library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", library)
    pictures: list[np.ndarray] = []
    take = film(SWIMMER.id, {}, lambda frames: np.zeros(2), pictures.append, steps=3, size=32)
    assert (take.steps, take.fell, take.seconds) == (3, False, 3 / 25)
    assert len(pictures) == 4


@pytest.mark.parametrize("robot", [SWIMMER, HOPPER])
def test_films_show_25_pictures_of_a_second(robot: Robot) -> None:
    assert pictures_per_second(robot.id, {"physics": "v3"}) == 25


def test_a_robot_of_fewer_steps_is_shown_at_every_step() -> None:
    every = [rendering._steps_per_picture(steps) for steps in (20, 25, 49, 50, 125)]
    assert every == [1, 1, 1, 2, 5]


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(ValueError, match="IndustrialBenchmark-v0 cannot be drawn; what can be are"):
        film(INDUSTRIAL_BENCHMARK_ID, {}, lambda frames: frames, lambda picture: None)


def test_the_first_library_that_works_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(rendering, "_works", lambda library: True)
    assert drawing_library() == "egl"
    monkeypatch.setattr(rendering, "_works", lambda library: library == "osmesa")
    assert drawing_library() == "osmesa"
    monkeypatch.setenv("MUJOCO_GL", "EGL")
    with pytest.raises(OSError, match=r"MUJOCO_GL=egl cannot .* library EGL is missing or broken"):
        drawing_library()
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setattr(rendering, "_works", lambda library: False)
    with pytest.raises(OSError, match="neither EGL nor OSMesa works; install one of them"):
        drawing_library()


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        (
            "OSMESA",
            "MUJOCO_GL=osmesa cannot draw here, since the library OSMesa is missing or broken; "
            "install it (on Debian: libosmesa6), or unset it to use whatever works, or set it to "
            "egl.",
        ),
        (
            "junk",
            "MUJOCO_GL=junk cannot draw without a screen, as egl and osmesa do; unset it to use "
            "whatever works, or set it to egl or osmesa.",
        ),
        ("glfw", "MUJOCO_GL=glfw cannot draw without a screen, as egl and osmesa do; unset it"),
        ("wgl", "MUJOCO_GL=wgl cannot draw without a screen, as egl and osmesa do; unset it"),
        ("off", "MUJOCO_GL=off cannot draw without a screen, as egl and osmesa do; unset it"),
    ],
)
def test_a_named_library_that_does_not_work_is_named_with_the_variable(
    value: str, sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", value)
    monkeypatch.setattr(rendering, "_works", lambda library: False)
    with pytest.raises(OSError, match=r"^MUJOCO_GL=") as told:
        drawing_library()
    assert str(told.value).startswith(sentence)


def test_a_library_that_fails_later_is_named_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(robot: object) -> None:
        raise RuntimeError("Offscreen framebuffer is not complete")

    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(rendering, "_works", lambda library: True)
    monkeypatch.setattr("gymnasium.envs.mujoco.mujoco_env.MujocoEnv.render", broken)
    with pytest.raises(OSError, match=r"^MUJOCO_GL=egl cannot draw such a picture here \(Offscr"):
        film(SWIMMER.id, {}, lambda frames: np.zeros(2), lambda picture: None, steps=3, size=32)


def test_a_library_that_is_not_there_does_not_work() -> None:
    assert not rendering._works("no_such_library")


IMPORT = """
from components.environments.systems import make_batch
import components.environments.mujoco.gymnasium_api, os
print(make_batch("proximity/Swimmer-v0", 2).copies, os.environ["MUJOCO_GL"])
"""


@pytest.mark.parametrize("value", ["junk", "osmesa"])
@pytest.mark.slow(2)
def test_robots_run_whatever_the_variable_says(value: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", IMPORT],
        env={**os.environ, "MUJOCO_GL": value},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, f"2 {value}\n"), done.stderr
