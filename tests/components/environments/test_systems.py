"""The registry: whoever asks by name or id finds what it says."""

import copy
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import mujoco
import pytest

from components.environments.mujoco import gymnasium_api, specifications
from components.environments.mujoco.specifications import HOPPER, ROBOTS, Robot, load_model
from components.environments.rendering import DRAWABLE
from components.environments.systems import (
    INDUSTRIAL_BENCHMARK,
    SYSTEMS,
    WORLD,
    System,
    check_simulator,
    make_batch,
)


def test_every_robot_is_a_system() -> None:
    robots = {robot.id for robot in ROBOTS.values()}
    assert set(SYSTEMS) >= {INDUSTRIAL_BENCHMARK.id, WORLD.id, *robots}
    assert all(name == system.id for name, system in SYSTEMS.items())
    assert all(name == robot.name for name, robot in ROBOTS.items())
    assert robots <= set(DRAWABLE) == {system.id for system in SYSTEMS.values() if system.drawable}
    assert INDUSTRIAL_BENCHMARK.id not in DRAWABLE


@pytest.mark.parametrize("name", SYSTEMS)
def test_gymnasium_and_batches_make_the_same_system(name: str) -> None:
    system = SYSTEMS[name]
    spec = gym.spec(name)
    assert (spec.entry_point, spec.vector_entry_point) == (
        system.entry_point,
        system.vector_entry_point,
    )
    batch = make_batch(name, 2)
    single = gym.make(name)
    assert single.action_space.shape == (len(batch.action_features),)
    features = {*system.dynamics["known"]["features"], *system.dynamics["learned"]}
    assert features >= {*batch.frame_features, *batch.action_features}


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
def test_single_robots_have_classes_that_can_be_copied(robot: Robot) -> None:
    single = gym.make(robot.id, physics="v5").unwrapped
    assert type(single) is getattr(gymnasium_api, robot.class_name)
    assert type(single).__name__ == robot.class_name
    for again in (copy.deepcopy(single), pickle.loads(pickle.dumps(single))):
        assert type(again) is type(single)
        assert again._physics == "v5"


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
def test_systems_tell_their_simulator(system: System) -> None:
    found = system.simulator()
    own = system in (INDUSTRIAL_BENCHMARK, WORLD)
    assert (found == "") == own
    assert own or found.startswith(f"mujoco {mujoco.__version__} on {system.name}.xml ")
    check_simulator(system.id, found)
    with pytest.raises(ValueError, match=rf"{system.id} was planned with mujoco 2\.0, but .* has"):
        check_simulator(system.id, "mujoco 2.0")


def test_another_model_is_another_simulation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = SYSTEMS[HOPPER.id].simulator()
    assert load_model(HOPPER, "v3").opt.timestep > 0  # of the same file
    text = (specifications._ASSETS / "hopper.xml").read_text(encoding="utf-8")
    (tmp_path / "hopper.xml").write_text(text.replace("0.002", "0.001"), encoding="utf-8")
    monkeypatch.setattr(specifications, "_ASSETS", tmp_path)
    assert SYSTEMS[HOPPER.id].simulator() != before


def test_names_that_are_none_are_refused() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'HorseRobot'"):
        _ = gymnasium_api.HorseRobot
    with pytest.raises(ValueError, match="has no parameter 'setpoint'; it has physics"):
        make_batch(HOPPER.id, 2, setpoint=70.0)


def test_knowing_the_systems_does_not_load_their_simulator() -> None:
    asked = "import sys, components.environments; print('mujoco' in sys.modules)"
    root = Path(__file__).parents[3]
    done = subprocess.run([sys.executable, "-c", asked], cwd=root, capture_output=True, text=True)
    assert done.stdout.strip() == "False", done.stderr
