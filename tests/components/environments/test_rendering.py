"""Films of robots, really drawn where a library can; what is said where none can."""

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
    with pytest.raises(OSError, match="MUJOCO_GL=egl cannot draw without a screen here; unset it"):
        drawing_library()
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setattr(rendering, "_works", lambda library: False)
    with pytest.raises(OSError, match="neither EGL nor OSMesa works; install one of them"):
        drawing_library()


def test_a_library_that_is_not_there_does_not_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with pytest.raises(OSError, match="MUJOCO_GL=glfw cannot draw"):
        drawing_library()  # it opens windows
    assert not rendering._works("no_such_library")
