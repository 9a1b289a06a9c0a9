"""WSBC's fitness by plain loops, its box, its limits, and a machine whose best policy is known."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from components.algorithms import wsbc
from components.algorithms.parts.learner import LearnerInputs
from components.core.normaliser import Normaliser
from components.core.random_streams import lane_key
from components.data.batches import LaneData
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.policies.policy import Policy
from tests.components.algorithms.stacks import SMALL, learner, run
from tests.components.algorithms.test_lion import STEPS, arrays, plain_policy
from tests.components.models.transition.test_model_environment import by_loop, constant_ensemble
from tests.components.synthetic import (
    CPU,
    make_log,
    policy_card,
    random_ensemble,
    random_policy,
)

LOG = make_log()
OTHER = make_log("other", seed=5)


def starts_of(made: wsbc.Learner, lane: int = 0) -> np.ndarray:
    """Raw histories ``[S, H, F]`` in which a lane's virtual trajectories start."""
    frames = made._behaviour.frames
    seen = made._observations[lane].unflatten(1, (-1, frames.mean.shape[-1]))
    return (seen * frames.scale[lane] + frames.mean[lane]).numpy()


def made_of(
    behaviour: list[Policy], ensembles: list[RecurrentEnsemble], logs: list, **changes: Any
) -> wsbc.Learner:
    """A learner on given models."""
    inputs = LearnerInputs(
        data=LaneData(logs, CPU),
        keys=[lane_key(log.card.name, "wsbc") for log in logs],
        models={"behaviour_policy": behaviour, "recurrent_ensemble": ensembles},
    )
    return wsbc.Learner(wsbc.Config(**(SMALL["wsbc"] | changes)), inputs)


def layers_at(position: torch.Tensor, behaviour: Policy) -> list[tuple[np.ndarray, np.ndarray]]:
    """A particle's weights and biases in double precision, cut from its row one by one."""
    numbers, layers, place = position.double().numpy(), [], 0
    for weight, _ in behaviour.layers:
        inputs, outputs = weight.shape[1:]
        matrix = numbers[place : place + inputs * outputs].reshape(inputs, outputs)
        place += inputs * outputs
        layers.append((matrix, numbers[place : place + outputs]))
        place += outputs
    assert place == len(numbers)
    return layers


def virtual_return(
    layers: list, scaling: Normaliser, ensemble: RecurrentEnsemble, start: np.ndarray
) -> float:
    """Discounted return of one policy from one start state, acting step by step."""
    mean, scale = scaling.mean.double().numpy(), scaling.scale.double().numpy()
    history, actions, rewards = start.astype(np.float64), [], np.empty(0)
    for _ in range(SMALL["wsbc"]["horizon"]):
        actions.append(plain_policy(layers, ((history - mean) / scale).flatten()))
        # The loop starts over each time: slow, and nothing can be carried over wrongly.
        rewards, frames, _ = by_loop(ensemble, start, np.array(actions))
        history = np.concatenate([frames[-1:], history[:-1]])
    return float(0.97 ** np.arange(len(rewards)) @ rewards)


def test_fitness_by_plain_loops() -> None:
    """Two lanes with own data, clones and ensembles; a clone's scaling is not the data's."""
    logs = [LOG, OTHER]
    ensembles = [random_ensemble(log, log.card.name) for log in logs]
    behaviour = [random_policy(log, (log.card.name,)) for log in logs]
    frames = behaviour[0].frames
    own = Normaliser(frames.mean + 3.0, 1.7 * frames.scale)
    behaviour[0] = dataclasses.replace(behaviour[0], frames=own)
    made = made_of(behaviour, ensembles, logs, particles=4)
    positions = made._swarm.positions.clone()
    metrics = made.update(0)
    fitness = made._swarm.best_fitness  # the first iteration's
    for lane in range(2):
        scaling = Normaliser(behaviour[lane].frames.mean[0], behaviour[lane].frames.scale[0])
        expected = []
        for n in range(4):
            layers = layers_at(positions[lane, n], behaviour[lane])
            starts = starts_of(made, lane)
            assert len(starts) == 6
            returns = [virtual_return(layers, scaling, ensembles[lane], s) for s in starts]
            expected.append(np.mean(returns))
        # five recurrent steps in float32
        np.testing.assert_allclose(fitness[lane], expected, rtol=1e-4)
        assert float(metrics["policy/virtual_return"][lane]) == pytest.approx(
            max(expected), rel=1e-4
        )
        assert float(metrics["swarm/virtual_return"][lane]) == pytest.approx(
            np.mean(expected), rel=1e-4
        )
        assert np.ptp(expected) > 1e-3 * abs(np.mean(expected)), "particles must differ"
    policy = made.policy(policy_card())
    best = fitness.argmax(dim=1)
    for lane in range(2):
        expected_layers = layers_at(positions[lane, best[lane]], behaviour[lane])
        for ours, theirs in zip(
            arrays(policy.lane(lane, policy.card).layers), expected_layers, strict=True
        ):
            assert np.array_equal(ours[0], theirs[0])
            assert np.array_equal(ours[1], theirs[1])
        assert torch.equal(policy.frames.mean[lane], behaviour[lane].frames.mean[0])
        assert torch.equal(policy.frames.scale[lane], behaviour[lane].frames.scale[0])


@pytest.mark.parametrize("after", [0, 2])
def test_start_states_are_those_asked_for_and_stay_the_same(after: int) -> None:
    window = {"start_after": after, "start_window": after + 4}
    made = learner("wsbc", [LOG], [0], starts=300, particles=3, box=0.0, **window)
    early = np.stack(
        [
            [LOG.frames[e * (STEPS + 1) + max(t - lag, 0)] for lag in range(3)]
            for e in range(6)
            for t in range(after, after + 4)
        ]
    )
    found = starts_of(made)
    apart = np.abs(found[:, None] - early[None]).max(axis=(2, 3))
    # scaled and back in float32, values up to 100; no two candidates are nearer than 3
    assert (apart.min(axis=1) < 1e-4).all()
    chosen = set(apart.argmin(axis=1).tolist())
    assert chosen == set(range(24)), "300 draws of 24: one misses with chance 7e-5"
    # Particles of a box without width never move: any other start state would show.
    metrics = run(made, 5)
    for later in metrics[1:]:
        assert torch.equal(later["swarm/virtual_return"], metrics[0]["swarm/virtual_return"])


def test_without_a_box_it_is_the_behaviour_policy() -> None:
    logs = [LOG, OTHER]
    made = learner("wsbc", logs, [0, 0], box=0.0)
    run(made, 10)
    policy = made.policy(policy_card())
    for lane, log in enumerate(logs):
        clone = random_policy(log, (log.card.name,))
        alone = policy.lane(lane, policy.card)
        for (weight, bias), (expected, offset) in zip(alone.layers, clone.layers, strict=True):
            assert torch.equal(weight, expected)
            assert torch.equal(bias, offset)
        histories = torch.from_numpy(log.frames[:30].reshape(1, 10, 3, 6).copy())
        assert torch.equal(alone.act(histories), clone.act(histories))


def test_before_the_first_iteration_it_is_the_behaviour_policy() -> None:
    policy = learner("wsbc", [LOG], [0]).policy(policy_card())
    for (weight, _), (expected, _) in zip(
        policy.layers, random_policy(LOG, ("toy",)).layers, strict=True
    ):
        assert torch.equal(weight, expected)


def test_the_others_begin_uniformly_in_the_box() -> None:
    made = learner("wsbc", [LOG] * 2, [0, 1], particles=41, box=0.2)
    away = made._swarm.positions - made._centre[:, None]
    assert (away[:, 0] == 0.0).all()
    assert (made._swarm.velocities == 0.0).all()
    others = away[:, 1:].flatten().double()
    assert others.abs().max() <= 0.2 + 1e-6  # float32 sums of numbers near 1
    # U(-0.2, 0.2): mean 0, deviation 0.2 / sqrt(3) = 0.1155; five standard errors of the draws
    assert len(others) == 2 * 40 * 179
    assert float(others.mean()) == pytest.approx(0.0, abs=5 * 0.1155 / 14320**0.5)
    # of a uniform sample's deviation: sqrt((1.8 - 1) / 4) = 0.45 of it, by the root of the number
    assert float(others.std()) == pytest.approx(0.1155, rel=5 * 0.45 / 14320**0.5)


def test_iterations_stay_in_the_box_and_never_lose_the_best() -> None:
    made = learner("wsbc", [LOG] * 2, [0, 1], box=0.05)
    low, high = made._centre - 0.05, made._centre + 0.05
    before = torch.full((2,), -torch.inf)
    touched = False
    for step in range(40):
        metrics = made.update(step)
        swarm = made._swarm
        for position in (swarm.positions, swarm.best_positions):
            assert (position >= low[:, None]).all()
            assert (position <= high[:, None]).all()
        touched |= bool((swarm.positions == high[:, None]).any())
        assert (metrics["policy/virtual_return"] >= before).all()
        before = metrics["policy/virtual_return"]
        assert (metrics["policy/virtual_return"] >= metrics["swarm/virtual_return"]).all()
        assert (metrics["policy/weight_distance"] <= 0.05 + 1e-6).all()  # float32
    assert touched, "the box must have been felt"
    assert not any(tensor.requires_grad for tensor in made.state_dict().values())


def test_a_particle_without_a_defined_return_is_the_worst(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lane 0 searches on with its other particles; lane 1, where none is left, ends."""
    made, alone = (learner("wsbc", [LOG] * 2, [0, 1], particles=5, box=0.05) for _ in range(2))
    fitness = made._fitness

    def failing() -> torch.Tensor:
        found = fitness()
        found[0, 1], found[0, 3], found[1] = torch.nan, torch.inf, torch.nan
        return found

    monkeypatch.setattr(made, "_fitness", failing)
    for step in range(4):
        before = fitness()[0, [0, 2, 4]]
        metrics = made.update(step)
        assert all(bool(metric[0].isfinite()) for metric in metrics.values())
        assert float(metrics["swarm/virtual_return"][0]) == pytest.approx(float(before.mean()))
        assert metrics["swarm/virtual_return"][1].isnan()
    assert made._swarm.best_fitness[0].isfinite().tolist() == [True, False, True, False, True]
    # Where all are defined nothing changes, not even a bit.
    defined = alone._fitness()
    assert torch.equal(alone.update(0)["swarm/virtual_return"], defined.mean(dim=1))


@pytest.mark.parametrize("at_once", [1, 13, 40, 10_000])
def test_chunks_do_not_change_the_result(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    logs = [LOG, OTHER]
    sizes = {"particles": 7, "starts": 5, "box": 0.1}
    whole = learner("wsbc", logs, [0, 1], **sizes)
    monkeypatch.setattr(wsbc, "TRAJECTORIES_AT_ONCE", {"cpu": at_once})
    unrolled: list[int] = []
    chunked = learner("wsbc", logs, [0, 1], **sizes)
    unroll = chunked._environment.unroll

    def watched(history: torch.Tensor, *args: Any, **named: Any) -> Any:
        unrolled.append(history.shape[1])
        return unroll(history, *args, **named)

    chunked._environment.unroll = watched  # type: ignore[method-assign]
    for step in range(3):
        run(whole, 1, step)
        run(chunked, 1, step)
    # Particles of 2 lanes with 5 start states each: 10 trajectories
    expected = {1: [5] * 7, 13: [5] * 7, 40: [20, 15], 10_000: [35]}[at_once]
    assert unrolled == expected * 3
    for name, tensor in whole.state_dict().items():
        # float32 products of other shapes
        torch.testing.assert_close(chunked.state_dict()[name], tensor, rtol=1e-5, atol=1e-6)


def consuming(weight: float = 0.5) -> RecurrentEnsemble:
    """Predicts a consumption that grows with the velocity, and a constant fatigue."""
    ensemble = constant_ensemble([0.0], [0.0])
    ensemble.weight[1, 0, 2 + 1] = weight  # velocity into the first hidden unit
    ensemble.readout[1, 0, 0] = 2.0
    return ensemble


def test_it_finds_the_known_direction_within_the_box() -> None:
    """Where less velocity is all that counts, every policy lowers it as far as its box allows."""
    sizes = {"box": 0.05, "particles": 40, "neighbourhood": 7, "starts": 20}
    clone = random_policy(LOG, ("toy",))
    made = made_of([clone], [consuming()], [LOG], **sizes)
    scaling = Normaliser(clone.frames.mean[0], clone.frames.scale[0])
    lowered = arrays(clone.layers)
    lowered[-1][1][0] -= 0.05  # the velocity's bias, all that box allows: plainly better
    starts = starts_of(made)
    target = np.mean([virtual_return(lowered, scaling, consuming(), s) for s in starts])
    at_first = np.mean(
        [virtual_return(arrays(clone.layers), scaling, consuming(), s) for s in starts]
    )
    assert target > at_first
    metrics = run(made, 60)
    gain = float(metrics[-1]["policy/virtual_return"][0]) - at_first
    # measured 6.2 times the gain of that one weight: there are 179
    assert gain > 4.0 * (target - at_first)
    histories = torch.from_numpy(LOG.frames[:60].reshape(1, 20, 3, 6).copy())
    away = made.policy(policy_card()).act(histories) - clone.act(histories)
    assert (away[0, :, 0] < 0.0).all()


def test_a_wider_box_finds_more() -> None:
    found = []
    for box in (0.0, 0.02, 0.2):
        made = made_of([random_policy(LOG, ("toy",))], [consuming()], [LOG], box=box)
        found.append(float(run(made, 30)[-1]["policy/virtual_return"][0]))
    assert found == sorted(found)
    assert found[2] - found[1] > found[1] - found[0] > 0.0


def test_no_weight_changes_by_more_than_the_velocity_limit() -> None:
    logs, sizes = [LOG, OTHER], {"box": 0.3, "velocity_limit": 0.1}
    made = learner("wsbc", logs, [0, 1], **sizes)
    reached = 0.0
    for step in range(10):
        before = made._swarm.positions.clone()
        run(made, 1, step)
        moved = float((made._swarm.positions - before).abs().max())
        assert moved <= 0.1 * 0.3 + 1e-6  # float32
        reached = max(reached, moved)
    assert reached > 0.99 * 0.03, "the limit must have been felt"
    alone = learner("wsbc", logs[1:], [1], **sizes)
    for step in range(10):
        run(alone, 1, step)
    # ten iterations in float32, side by side and alone
    torch.testing.assert_close(
        made._swarm.positions[1:], alone._swarm.positions, rtol=1e-4, atol=1e-5
    )


def test_the_default_pace_is_the_one_of_the_published_comparison() -> None:
    assert wsbc.Config().velocity_limit == 0.1
    assert "no weight changes by more than a tenth of d" in str(wsbc.__doc__)


def test_the_thesis_searches_3683_weights_with_200_particles() -> None:
    log = make_log(history=30)
    clone = random_policy(log, ("big",), hidden=20)
    inputs = LearnerInputs(
        data=LaneData([log], CPU),
        keys=[1],
        models={
            "behaviour_policy": [clone],
            "recurrent_ensemble": [random_ensemble(log, "big")],
        },
    )
    made = wsbc.Learner(wsbc.Config(), inputs)
    assert made._swarm.positions.shape == (1, 200, 3683)
    assert made._swarm._ring.shape == (200, 31)
    assert made._observations.shape == (1, 200, 180)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"updates": 0}, "must be at least 1"),
        ({"particles": 0, "neighbourhood": 1}, "must be at least 1"),
        ({"starts": 0}, "must be at least 1"),
        ({"neighbourhood": 30}, "must be odd and at most the number of particles, got 30 of 200"),
        ({"neighbourhood": 201}, "must be odd and at most the number of particles"),
        ({"box": -0.1}, "must not be negative"),
        ({"ring_pull": -1.0}, "must not be negative"),
        ({"velocity_limit": 0.0}, r"velocity_limit must lie in \(0, 2\], got 0.0"),
        ({"velocity_limit": 2.1}, r"velocity_limit must lie in \(0, 2\], got 2.1"),
        ({"inertia": 1.0}, r"inertia must lie in \[0, 1\), got 1.0"),
        ({"discount": 0.0}, r"discount must lie in \(0, 1\], got 0.0"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        wsbc.Config(**changes)
