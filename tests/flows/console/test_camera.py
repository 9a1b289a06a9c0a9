"""The camera of a robot: pictures of where it is, and a sentence where nothing can draw."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from components.environments.mujoco.specifications import HOPPER
from components.environments.rendering import Camera, drawing_library
from components.operating.operable import Operable
from flows.console.bench import Bench
from flows.console.camera import Filming
from tests.components.operating.machines import LOG
from tests.components.synthetic import constant_policy


def still_hopper() -> Operable:
    """A hopper that does nothing."""
    card = dataclasses.replace(
        LOG.card,
        environment=HOPPER.id,
        environment_parameters={"physics": "v3"},
        frame_features=HOPPER.frame_features,
        action_features=HOPPER.action_features,
    )
    policy = constant_policy([0.0, 0.0, 0.0], HOPPER.frame_features, history=1)
    return Operable(policy, policy, card)


def hopper() -> Bench:
    """A window of it."""
    return Bench(still_hopper(), "hopper")


def filmed(bench: Bench) -> tuple[list[str], list[str]]:
    """Addresses of pictures and sentences of a camera that looks once."""
    shown: list[str] = []
    failed: list[str] = []
    filming = Filming(bench, shown.append, failed.append)
    filming.look()
    filming.close()
    filming._thread.shutdown(wait=True)
    filming.look()  # a closed one does nothing
    return shown, failed


@pytest.mark.slow(2)
def test_a_robot_is_drawn_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        monkeypatch.setenv("MUJOCO_GL", drawing_library())
    except OSError as error:
        pytest.skip(str(error))
    bench = hopper()
    assert bench.drawable
    positions, velocities = bench.pose()
    assert positions.shape == velocities.shape == (6,)
    bench.step()
    assert not np.array_equal(bench.pose()[0], positions)
    [address], failed = filmed(bench)
    assert address.startswith("data:image/jpeg;base64,")
    assert failed == []
    camera = Camera(*bench.system, size=64)
    standing = camera.picture(positions, velocities)
    lying = camera.picture(positions + np.array([0, -0.8, 1.4, 0, 0, 0]), velocities)
    camera.close()
    assert standing.shape == (64, 64, 3)
    assert (standing != lying).any()


def test_what_cannot_be_drawn_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    shown, failed = filmed(hopper())
    assert shown == []
    assert len(failed) == 1
    assert failed[0].startswith("The robot is not drawn: MUJOCO_GL=glfw cannot draw without")
