"""The vectorised machine: against the scalar one, its anchors, its start and its streams."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.scalar_industrial_benchmark import (
    ScalarIndustrialBenchmark,
    TunedScalarIndustrialBenchmark,
)
from components.data.controllers.industrial import bad, mediocre, optimized
from components.environments.frame_history import FrameHistory
from components.environments.industrial.benchmark import IndustrialBenchmark
from components.environments.industrial.noise import DrawnNoise, Noise

Array = NDArray[np.float64]


class QueuedDraws:
    """Gives a scalar machine the draws of one copy, from the same `Noise` batches."""

    def __init__(self, copy: int) -> None:
        self._copy = copy
        self._values: dict[str, list[float]] = {}

    def load(self, noise: Noise) -> None:
        value = {name: float(array[self._copy]) for name, array in vars(noise).items()}
        self._values = {
            "exponential": [value["gain_exponential"], value["velocity_exponential"]],
            "uniform": [value["gain_uniform"], value["velocity_uniform"]],
            "binary": [value["gain_binary"], value["velocity_binary"]],
            # both normals are equal in this test, so it does not matter how many are asked for
            "normal": [value["saturation_normal"], value["consumption_normal"]],
        }

    def exponential(self) -> float:
        return self._values["exponential"].pop(0)

    def uniform(self) -> float:
        return self._values["uniform"].pop(0)

    def binary(self, chance: float) -> int:
        return int(self._values["binary"].pop(0))

    def normal(self) -> float:
        return self._values["normal"].pop(0)


def random_noise(rng: np.random.Generator, copies: int) -> Noise:
    normal = rng.standard_normal(copies)
    return Noise(
        gain_exponential=rng.exponential(0.1, copies),
        velocity_exponential=rng.exponential(0.1, copies),
        gain_uniform=rng.random(copies),
        velocity_uniform=rng.random(copies),
        gain_binary=rng.integers(0, 2, copies).astype(np.float64),
        velocity_binary=rng.integers(0, 2, copies).astype(np.float64),
        saturation_normal=normal,
        consumption_normal=normal,
    )


@pytest.mark.parametrize("kind", [ScalarIndustrialBenchmark, TunedScalarIndustrialBenchmark])
@pytest.mark.parametrize("setpoint", [0.0, 70.0, 100.0])
def test_vectorised_equals_scalar_loop(
    kind: type[ScalarIndustrialBenchmark], setpoint: float
) -> None:
    rng = np.random.default_rng(3)
    copies, steps = 5, 300
    # each copy drifts another way, so that caps, floors and saturation are all met
    drift = rng.uniform(-0.9, 0.9, (copies, 3))
    machines = IndustrialBenchmark(copies, setpoint)
    first = random_noise(rng, copies)
    frames = machines.reset(noise=first)
    draws = [QueuedDraws(copy) for copy in range(copies)]
    scalars = [kind(draw, setpoint) for draw in draws]
    for draw, scalar, frame in zip(draws, scalars, frames, strict=True):
        draw.load(first)
        np.testing.assert_allclose(scalar.reset(), frame, rtol=1e-12)
    saturated = False
    for _ in range(steps):
        noise = random_noise(rng, copies)
        actions = drift + rng.uniform(-1.0, 1.0, (copies, 3))
        frames, rewards = machines.step(actions, noise)
        for copy, scalar in enumerate(scalars):
            draws[copy].load(noise)
            frame, reward = scalar.step(actions[copy])
            # the same float64 equations in another order of operations
            np.testing.assert_allclose(frames[copy], frame, rtol=1e-9)
            assert rewards[copy] == pytest.approx(reward, rel=1e-9)
            saturated |= max(scalar.hidden_gain, scalar.hidden_velocity) == 5.0
    assert saturated


def constant(*action: float) -> Callable[[Array], Array]:
    return lambda history: np.broadcast_to(np.array(action), (len(history), 3))


@pytest.mark.parametrize(
    ("policy", "published"),
    [
        (constant(0.0, 0.0, 0.0), -64.9),
        (constant(-1.0, -1.0, -1.0), -151.0),
        (constant(1.0, 1.0, 1.0), -326.8),
        (constant(1.0, 1.0, -1.0), -327.3),
        (bad, -326.8),
        (mediocre, -78.3),
        (optimized, -59.7),
    ],
    ids=["zero", "all-low", "worst-high", "worst-low", "bad", "mediocre", "optimized"],
)
def test_discounted_returns_meet_the_published_ones(
    policy: Callable[[Array], Array], published: float
) -> None:
    copies = 1000
    machines = IndustrialBenchmark(copies)
    history = FrameHistory(machines.reset(np.random.default_rng(11)))
    returns = np.zeros(copies)
    for step in range(100):
        frames, rewards = machines.step(policy(history.window))
        history.push(frames)
        returns += 0.97**step * rewards
    # both are means of 1,000 episodes: five standard errors of their difference (false alarm
    # below 1e-6), and half of the last printed digit
    tolerance = 5.0 * math.sqrt(2.0) * returns.std() / math.sqrt(copies) + 0.05
    assert returns.mean() == pytest.approx(published, abs=tolerance)


def test_same_seed_same_run_other_seed_other_run() -> None:
    def run(seed: int) -> Array:
        machines = IndustrialBenchmark(4)
        frames = [machines.reset(np.random.default_rng(seed))]
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 4, 3))
        frames += [machines.step(action)[0] for action in actions]
        return np.stack(frames)

    assert np.array_equal(run(1), run(1))
    assert not np.array_equal(run(1), run(2))


def test_a_second_thread_changes_no_number() -> None:
    def run(threads: int) -> Array:
        machines = IndustrialBenchmark(600, threads=threads)
        rng = np.random.default_rng(0)
        drift = rng.uniform(-0.9, 0.9, (600, 3))
        frames = [machines.reset(np.random.default_rng(seed=1))]
        for step in range(60):  # several blocks of draws
            actions = drift + rng.uniform(-1.0, 1.0, (600, 3))
            frames.append(machines.step(actions)[0])
            if step == 20:  # in the middle of a block that is being drawn
                frames.append(machines.reset(np.random.default_rng(seed=2)))
        return np.stack(frames)

    np.testing.assert_array_equal(run(1), run(2))


def test_copies_have_their_own_noise_and_do_not_feel_each_other() -> None:
    def run(others: float) -> Array:
        machines = IndustrialBenchmark(3)
        machines.reset(np.random.default_rng(5))
        actions = np.zeros((3, 3))
        actions[1:] = others
        return np.stack([machines.step(actions)[0] for _ in range(60)])

    calm, wild = run(0.0), run(1.0)
    assert np.array_equal(calm[:, 0], wild[:, 0])
    assert not np.array_equal(calm[:, 0, 5], calm[:, 1, 5])


def test_no_global_random_state_is_touched() -> None:
    before = np.random.get_state()[1].copy()  # noqa: NPY002 - the state that must not change
    machines = IndustrialBenchmark(2)
    machines.reset(np.random.default_rng(0))
    machines.step(np.zeros((2, 3)))
    assert np.array_equal(before, np.random.get_state()[1])  # noqa: NPY002


def test_steering_step_sizes_limits_and_clipped_actions() -> None:
    machines = IndustrialBenchmark(2, setpoint=30.0)
    machines.reset(np.random.default_rng(0))
    frames, _ = machines.step([[1.0, -1.0, 1.0], [7.0, -7.0, 7.0]])
    shift = 50.0 + 20.0 * math.sin(math.radians(15.0)) / 0.9
    expected = [30.0, 51.0, 40.0, shift]
    np.testing.assert_allclose(frames[:, :4], [expected, expected], rtol=1e-15)
    for _ in range(60):
        frames, _ = machines.step([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]])
    assert frames[0, 1:4].tolist() == [100.0, 100.0, 100.0]
    assert frames[1, 1:4].tolist() == [0.0, 0.0, 0.0]


def test_reward_is_of_the_new_state() -> None:
    machines = IndustrialBenchmark(3)
    machines.reset(np.random.default_rng(0))
    frames, rewards = machines.step(np.full((3, 3), 0.3))
    expected = -(3.0 * frames[:, 4] + frames[:, 5]) / 100.0
    np.testing.assert_allclose(rewards, expected, rtol=1e-14)  # rounding of one sum


def test_setpoint_changes_what_the_machine_costs() -> None:
    def consumption(setpoint: float) -> float:
        machines = IndustrialBenchmark(1, setpoint)
        return float(machines.reset(noise=Noise.zeros(1))[0, 5])

    # noise-free: 0.99999 times the cost of the start, plus the mis-calibration of at least zero
    for setpoint in (10.0, 90.0):
        cost = 0.99999 * math.exp((2.0 * setpoint + 325.0) / 100.0)
        assert cost <= consumption(setpoint) <= cost + 25.0 * 5.0


def test_start_state_is_where_the_machine_starts() -> None:
    machines = IndustrialBenchmark(2)
    start = {"velocity": 10.0, "gain": [20.0, 30.0], "shift": 40.0}
    frames = machines.reset(np.random.default_rng(0), start=start)
    np.testing.assert_array_equal(frames[:, 1:4], [[10.0, 20.0, 40.0], [10.0, 30.0, 40.0]])
    costs = machines.state()["operational_costs"]
    expected = math.exp((140.0 + 40.0 + 50.0) / 100.0)
    np.testing.assert_allclose(costs[0], expected, rtol=1e-12)  # rounding


def test_hidden_start_state_continues_a_run() -> None:
    rng = np.random.default_rng(2)
    whole = IndustrialBenchmark(6)
    whole.reset(rng)
    for _ in range(50):
        whole.step(rng.uniform(-1.0, 1.0, (6, 3)))
    state = whole.state()
    names = ("velocity", "gain", "shift", "hidden_velocity", "hidden_gain")
    latents = ("domain", "response", "direction", "operational_costs")
    start = {name: state[name] for name in names + latents}
    continued = IndustrialBenchmark(6)
    noise = Noise.zeros(6)
    first = continued.reset(start=start, noise=noise)
    following, _ = whole.step(np.zeros((6, 3)), noise)
    # the cost ring stands elsewhere, so its weighted sum is rounded in another order
    np.testing.assert_allclose(first, following, rtol=1e-13)


def test_reset_of_some_copies_leaves_the_others_alone() -> None:
    rng = np.random.default_rng(0)
    first, second = IndustrialBenchmark(4), IndustrialBenchmark(4)
    actions = rng.uniform(-1.0, 1.0, (30, 4, 3))
    for machines in (first, second):
        machines.reset(np.random.default_rng(7))
        for action in actions[:13]:
            machines.step(action)
    mask = np.array([False, True, False, True])
    frames = second.reset_copies(mask, np.random.default_rng(1))
    np.testing.assert_array_equal(frames[:, 1:4], 50.0)
    np.testing.assert_array_equal(second.state()["velocity"][mask], 50.0)
    np.testing.assert_array_equal(second.state()["operational_costs"][1], math.exp(4.65))
    for action in actions[13:]:
        one, two = first.step(action)[0], second.step(action)[0]
        np.testing.assert_array_equal(one[~mask], two[~mask])
        assert not np.array_equal(one[mask], two[mask])


def test_reset_copies_go_on_as_a_machine_of_their_own_would() -> None:
    rng = np.random.default_rng(0)
    machines = IndustrialBenchmark(4)
    machines.reset(np.random.default_rng(7))
    for _ in range(13):  # no multiple of ten: the cost ring stands elsewhere than a fresh one's
        machines.step(rng.uniform(-1.0, 1.0, (4, 3)))
    mask = np.array([False, True, False, True])
    # past costs that differ from one another, so that their order matters
    start = {"operational_costs": np.exp(rng.uniform(0.0, 5.0, (2, 10))), "gain": [20.0, 80.0]}
    fresh = IndustrialBenchmark(2)
    expected = fresh.reset(np.random.default_rng(1), start=start)
    got = machines.reset_copies(mask, np.random.default_rng(1), start=start)
    np.testing.assert_array_equal(got, expected)
    for _ in range(12):
        actions = rng.uniform(-1.0, 1.0, (4, 3))
        noise = random_noise(rng, 4)
        own = Noise(**{name: array[mask] for name, array in vars(noise).items()})
        # the cost ring stands elsewhere, so its weighted sum is rounded in another order
        np.testing.assert_allclose(
            machines.step(actions, noise)[0][mask], fresh.step(actions[mask], own)[0], rtol=1e-13
        )


def test_drawn_noise_has_the_distributions_of_the_method() -> None:
    copies, steps = 4000, 100
    noise = DrawnNoise(np.random.default_rng(0), copies)
    effective = np.stack([np.full(copies, 0.3), np.linspace(0.0, 1.0, copies)])
    base, used, binary, normal = [], [], [], []
    for _ in range(steps):
        squashed, uniform, outcome = noise.fatigue(effective)
        base.append(squashed.mean())
        used.append(uniform[0][outcome[0]])
        binary.append(outcome.mean(axis=1))
        normal.append(noise.consumption().copy())
    draws = copies * steps
    # five standard errors each; the squashed mean is 0.05 minus a cubic term of 0.00025
    assert np.mean(base) == pytest.approx(0.04976, abs=5.0 * 0.05 / math.sqrt(2 * draws))
    kept = np.concatenate(used)
    assert kept.mean() == pytest.approx(0.5, abs=5.0 * 0.289 / math.sqrt(len(kept)))
    assert 0.0 <= kept.min() <= kept.max() < 1.0
    chances = np.mean(binary, axis=0)
    assert chances[0] == pytest.approx(0.3, abs=5.0 * 0.46 / math.sqrt(draws))
    assert chances[1] == pytest.approx(0.5, abs=5.0 * 0.5 / math.sqrt(draws))
    assert np.std(normal) == pytest.approx(1.0, abs=5.0 / math.sqrt(2 * draws))


def test_the_draws_of_a_step_are_independent() -> None:
    copies, steps = 4000, 50
    noise = DrawnNoise(np.random.default_rng(0), copies)
    drawn = []
    for _ in range(steps):
        base, uniform, _ = noise.fatigue(np.full((2, copies), 0.999))
        saturation = noise.saturation(np.ones(copies, dtype=np.bool_))
        logit = np.log(saturation / (1.0 - saturation))
        drawn.append(np.stack([*base, *uniform, (logit - 2.4) / 0.4, noise.consumption()]))
    values = np.concatenate(drawn, axis=1)  # [6, draws]
    far = 5.0 / math.sqrt(copies * steps)  # five standard errors of a correlation
    np.testing.assert_allclose(np.corrcoef(values), np.eye(6), atol=far)
    # of a deviation, and of a mean
    np.testing.assert_allclose(values[4:].std(axis=1), 1.0, atol=far)
    np.testing.assert_allclose(values[4:].mean(axis=1), 0.0, atol=far)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ({"speed": 1.0}, "unknown start value 'speed'"),
        ({"velocity": 101.0}, "from 0.0 to 100.0"),
        ({"velocity": float("nan")}, "from 0.0 to 100.0"),
        ({"gain": [1.0, 2.0, 3.0]}, "give a number or"),
        ({"direction": 7.0}, "from -6.0 to 6.0"),
        ({"direction": 0.5}, "whole numbers"),
        ({"domain": 0.0}, "does not exist"),
        ({"operational_costs": [1.0]}, "oldest first"),
        ({"operational_costs": [-1.0] * 10}, "negative"),
    ],
)
def test_bad_start_states_are_refused(start: dict[str, float], message: str) -> None:
    machines = IndustrialBenchmark(2)
    with pytest.raises(ValueError, match=message):
        machines.reset(np.random.default_rng(0), start=start)


def test_misuse_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        IndustrialBenchmark(0)
    with pytest.raises(ValueError, match="threads is 0"):
        IndustrialBenchmark(1, threads=0)
    with pytest.raises(ValueError, match="from 0 to 100"):
        IndustrialBenchmark(1, setpoint=101.0)
    machines = IndustrialBenchmark(2)
    with pytest.raises(ValueError, match="before reset"):
        machines.step(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="needs a generator"):
        machines.reset()
    machines.reset(np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"need \(2, 3\)"):
        machines.step(np.zeros((3, 3)))
    before = machines.state()["velocity"]
    with pytest.raises(ValueError, match="not a number"):
        machines.step([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    np.testing.assert_array_equal(before, machines.state()["velocity"])
