"""MOReL's roll-outs, step and baseline against plain loops, and worlds whose answers are known."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from components.algorithms import morel
from components.algorithms.parts.halting import live_samples
from components.models.transition.model_environment import RolloutStep
from tests.components.algorithms.morel_worlds import (
    HALT_RETURN,
    HORIZON,
    LOG,
    MEMBERS,
    STEPS,
    history_of,
    in_world,
    linear_ensemble,
    means,
    prepared,
    rolled_out,
    scaled,
)
from tests.components.algorithms.plain import floats, network
from tests.components.algorithms.stacks import config, learner, run
from tests.components.models.plain import member_outputs, trajectory
from tests.components.synthetic import make_log, policy_card, random_model


def value(made: Any, lane: int, seen: np.ndarray, step: int) -> float:
    time = step / HORIZON
    inputs = np.concatenate([seen, [time, time**2, time**3, time**4]])
    return 50.0 * float(network(made._critic.stack, lane, inputs[None])[0, 0])  # the log's return


def trajectory_by_loop(made: Any, lane: int, row: int, member: int, noise: np.ndarray) -> tuple:
    """Rewards, doubts, observations and clamped actions of one trajectory."""
    ensemble = random_model("residual_ensemble", LOG)
    std = np.exp(floats(made._actor.log_std)[lane, 0])
    history = history_of(row).astype(np.float64)
    start, actions, seen, doubts = history_of(row), [], [], []
    rewards, frames = np.empty(0), np.empty((0, 6))
    for t in range(HORIZON):
        seen.append(scaled(history))
        actions.append(np.clip(means(made, lane, seen[-1]) + std * noise[t], -1.0, 1.0))
        # The loop starts over each time: slow, and nothing can be carried over wrongly.
        rewards, frames = trajectory(
            ensemble, start, np.array(actions), lambda t, r: member, np.zeros((t + 1, 2))
        )
        inputs = frames[-1, :4]
        said = np.array([member_outputs(ensemble, k, history, inputs)[0] for k in range(MEMBERS)])
        said /= ensemble.target_scale.double().numpy()
        doubts.append(max(np.linalg.norm(a - b) for a in said for b in said))
        history = np.concatenate([frames[-1:], history[:-1]])
    seen.append(scaled(history))
    return rewards, np.array(doubts), np.array(seen), np.array(actions)


def test_rollouts_by_plain_loops() -> None:
    made = prepared(0, 1)
    drawn, rolled = rolled_out(made)
    halted, clamped = set(), 0
    for lane, b in np.ndindex(2, 2 * MEMBERS):
        noise = floats(drawn["noise"])[lane, :, b]
        row, member = int(made._starts(drawn)[lane, b]), b // 2
        rewards, doubts, seen, actions = trajectory_by_loop(made, lane, row, member, noise)
        clamped += int((np.abs(actions) == 1.0).sum())
        threshold = float(made._detector.threshold[lane])
        # far above float32's rounding, so that it is clear what is unknown
        assert np.abs(doubts - threshold).min() > 1e-4
        first = int(np.argmax(doubts > threshold)) if (doubts > threshold).any() else HORIZON
        halted.add(first)
        alive = [t <= first for t in range(HORIZON)]
        assert rolled.ended.alive[:, lane, b].tolist() == alive
        assert rolled.ended.halts[:, lane, b].tolist() == [t == first for t in range(HORIZON)]
        expected = np.where(np.arange(HORIZON) == first, HALT_RETURN, rewards)[alive]
        # float32 through five steps of two networks
        np.testing.assert_allclose(
            floats(rolled.ended.rewards)[alive, lane, b], expected, rtol=1e-4
        )
        expected_values = [value(made, lane, seen[t], t) for t in range(HORIZON + 1)]
        np.testing.assert_allclose(
            floats(rolled.values)[:, lane, b], expected_values, rtol=1e-3, atol=1e-3
        )
        for t in range(HORIZON):
            index = torch.full((2, 1), t * 2 * MEMBERS + b)
            np.testing.assert_allclose(
                floats(rolled.states.observations(index))[lane, 0], seen[t], rtol=1e-4, atol=1e-4
            )
    assert len(halted) > 2, "some halt at different times"
    assert clamped > 10


def test_half_the_trajectories_begin_where_logged_ones_do() -> None:
    made = learner("morel", [LOG], [0], trajectories=200)
    start = made._starts(made._streams.at(0))[0]
    assert set((start[::2] % STEPS).tolist()) == {0}
    assert len(set(start[::2].tolist())) == 6
    # 300 uniform draws of 240 rows: fewer than 120 different ones have no chance to speak of
    assert len(set(start[1::2].tolist())) > 120
    assert not torch.equal(made._starts(made._streams.at(1))[0], start)


def advantages_by_loop(rolled: Any, lane: int) -> np.ndarray:
    """Whitened advantages ``[T, B]``, NaN where nobody lives."""
    rewards, values = floats(rolled.ended.rewards)[:, lane], floats(rolled.values)[:, lane]
    halts, alive = (x[:, lane].numpy() for x in (rolled.ended.halts, rolled.ended.alive))
    found = np.full(rewards.shape, np.nan)
    for b in range(rewards.shape[1]):
        for t in range(HORIZON):
            if not alive[t, b]:
                continue
            total, weight = 0.0, 1.0
            for k in range(t, HORIZON):
                ahead = 0.0 if halts[k, b] else 0.97 * values[k + 1, b]
                total += weight * (rewards[k, b] + ahead - values[k, b])
                weight *= 0.97 * 0.97
                if halts[k, b]:
                    break
            found[t, b] = total
    return (found - np.nanmean(found)) / np.nanstd(found)


def test_the_policy_moves_by_its_natural_gradient() -> None:
    """Explicit Jacobians of the means by central differences, and a dense solution."""
    changes = {"hidden": (2,), "damping": 0.1, "iterations": 60, "fisher_samples": 30}
    made = prepared(0, 1, **changes)
    drawn, rolled = rolled_out(made)
    live = live_samples(rolled.ended.alive.transpose(0, 1).flatten(1), drawn["order"])
    before = [p.detach().clone() for p in made._actor.vector()]
    # sample t * B + b is trajectory b's step t
    noise = np.stack(
        [floats(drawn["noise"])[:, n // 6, n % 6] for n in range(HORIZON * 2 * MEMBERS)], axis=1
    )
    weight, bias, last_weight, last_bias, log_std = (floats(p) for p in before)
    made._climb(rolled, live)
    moved = [
        floats(new) - floats(old) for new, old in zip(made._actor.vector(), before, strict=True)
    ]
    assert not rolled.ended.alive.all()
    for lane in range(2):
        vector = np.concatenate([p[lane].ravel() for p in (weight, bias, last_weight, last_bias)])
        std = np.exp(log_std[lane, 0])

        def mean(flat: np.ndarray, seen: np.ndarray) -> np.ndarray:
            w, b, v, c = np.split(flat, np.cumsum([36, 2, 6]))
            return np.tanh(seen @ w.reshape(18, 2) + b) @ v.reshape(2, 3) + c

        def jacobian(seen: np.ndarray, vector: np.ndarray = vector) -> np.ndarray:
            columns = []
            for entry in range(len(vector)):
                shift = np.zeros(len(vector))
                shift[entry] = 1e-6
                columns.append((mean(vector + shift, seen) - mean(vector - shift, seen)) / 2e-6)
            return np.stack(columns, axis=-1)  # [N, A, P]

        advantages = advantages_by_loop(rolled, lane).ravel()
        counts = np.flatnonzero(~np.isnan(advantages))
        own = torch.from_numpy(counts)[None].expand(2, -1)
        pulls = jacobian(floats(rolled.states.observations(own))[lane])
        a, e = advantages[counts, None], noise[lane, counts]
        gradient = np.einsum("nd,ndp->p", a * e / std, pulls) / len(counts)
        gradient = np.concatenate([gradient, (a * (e**2 - 1.0)).mean(axis=0)])
        # the matrix is estimated from the 30 samples that `live` names, the living ones repeated
        pulls = jacobian(floats(rolled.states.observations(live))[lane])
        size = len(gradient)
        matrix = np.zeros((size, size))
        matrix[:-3, :-3] = np.einsum("ndp,d,ndq->pq", pulls, std**-2.0, pulls) / len(pulls)
        matrix[-3:, -3:] = 2.0 * np.eye(3)
        ascent = np.linalg.solve(matrix + 0.1 * np.eye(size), gradient)
        step = np.sqrt(0.02 / (gradient @ ascent)) * ascent
        found = np.concatenate([part[lane].ravel() for part in moved])
        # float32 conjugate gradients at a condition number of some hundreds
        np.testing.assert_allclose(found, step, rtol=2e-3, atol=2e-3 * np.abs(step).max())


def test_portions_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    moved = []
    for portion in (2000, 7):
        monkeypatch.setattr(morel, "PORTION", portion)
        made = prepared(0)
        made.update(0)
        moved.append(torch.cat([p.detach().flatten() for p in made._actor.vector()]))
    # sums of thirty float32 gradients in another order, through the solver
    torch.testing.assert_close(*moved, rtol=1e-3, atol=1e-4)


def test_the_baseline_is_fitted_after_the_policy_has_moved() -> None:
    made, other = prepared(0), prepared(0)
    drawn, rolled = rolled_out(made)
    live = live_samples(rolled.ended.alive.transpose(0, 1).flatten(1), drawn["order"])
    made._climb(rolled, live)
    other.update(0)
    for ours, theirs in zip(made._actor.vector(), other._actor.vector(), strict=True):
        assert torch.equal(ours, theirs)
    # 30 samples in batches of 16
    assert {float(s["step"]) for s in other._optimizers["critic"].state.values()} == {2.0}


@pytest.mark.parametrize(
    ("beta", "share", "steps", "known"), [(-1e6, 1.0, 0.0, 0.0), (1e6, 0.0, 5.0, 1.0)]
)
def test_everything_or_nothing_halts(beta: float, share: float, steps: float, known: float) -> None:
    made = learner("morel", [LOG] * 2, [0, 1], beta=beta)
    for metrics in run(made, 14)[10:]:
        assert metrics["actor/halted_share"].tolist() == [share] * 2
        assert metrics["actor/steps_before_halt"].tolist() == [steps] * 2
        assert metrics["detector/known_share"].tolist() == [known] * 2
        if share:
            # float32 division
            assert metrics["actor/virtual_return"].tolist() == pytest.approx([HALT_RETURN] * 2)
        else:
            assert metrics["actor/virtual_return"].min() > 0.4 * HALT_RETURN


def test_a_prediction_that_is_undefined_halts_its_trajectory_and_no_lane(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From the second step on, the models predict nothing for half of the trajectories."""
    made = learner("morel", [LOG] * 2, [0, 1], beta=1e6, cloning=0)
    unroll = made._mdp._environment.unroll

    def failing(*given: Any) -> Iterator[RolloutStep]:
        for number, step in enumerate(unroll(*given)):
            lost = (torch.arange(step.rewards.shape[1]) % 2 == 0) & (number > 0)
            values = step.prediction.values.masked_fill(lost, torch.nan)
            yield dataclasses.replace(
                step,
                prediction=dataclasses.replace(step.prediction, values=values),
                rewards=step.rewards.masked_fill(lost, torch.nan),
                frames=step.frames.masked_fill(lost[:, None], torch.nan),
            )

    monkeypatch.setattr(made._mdp._environment, "unroll", failing)
    for metrics in run(made, 3):
        assert metrics["actor/halted_share"].tolist() == [0.5] * 2
        assert all(bool(metric.isfinite().all()) for metric in metrics.values())
    assert bool(made.policy(policy_card()).finite.all())


@pytest.mark.slow(2)
def test_the_baseline_learns_what_halt_pays() -> None:
    made = learner("morel", [LOG], [0], beta=-1e6, learning_rate=1e-2, cloning=0)
    metrics = run(made, 150)
    # weight decay and Adam's rate leave some of it; at first values are near 0
    assert metrics[0]["critic/value_magnitude"] < 0.3 * abs(HALT_RETURN)
    _, rolled = rolled_out(made, 150)
    assert floats(rolled.values[0]).mean() == pytest.approx(HALT_RETURN, rel=0.1)


def test_the_baseline_knows_the_horizon_of_a_constant_reward() -> None:
    """V(s, t) = r (1 - gamma^(T - t)) / (1 - gamma) where every step pays r and nothing ends."""
    made = in_world(
        linear_ensemble(LOG, (0.0, 0.0), -9.0),
        beta=1e6,
        horizon=20,
        trajectories=20,
        learning_rate=3e-3,
    )
    reward = float(-0.03 * LOG.frames[:, 4].mean() - 0.01 * LOG.frames[:, 5].mean())
    run(made, 20)
    _, rolled = rolled_out(made, 100)
    for t in range(0, 21, 4):
        expected = reward * (1.0 - 0.97 ** (20 - t)) / 0.03
        # a twentieth of the whole return; measured 0.8 off at most, and near 0 at first
        assert floats(rolled.values[t]).mean() == pytest.approx(expected, abs=1.4)
    assert reward / 0.03 * (1.0 - 0.97**20) < -28.0


def shifts(made: Any) -> torch.Tensor:
    """Normalised shifts at the end of the trajectories of a later update."""
    _, rolled = rolled_out(made, 1000)
    last = torch.arange(8 * 100, 9 * 100)[None]
    return rolled.states.observations(last)[0, :, 3]


@pytest.mark.slow(2)
def test_it_finds_the_known_optimum_and_halt_holds_it_in_the_known() -> None:
    """Consumption falls with the shift, so that the best action lowers it in every state.

    Where the shift is a deviation below the mean of the log, members begin to disagree.
    """
    world = linear_ensemble(LOG, (0.0, 1.0), -1.0)
    free, careful = in_world(world, beta=1e6), in_world(world, beta=3.0)
    returns = torch.stack([m["actor/virtual_return"] for m in run(free, 40)]).flatten()
    # measured with three seeds: from -12.9 to at most -10.5, mean actions of at most -0.76, below
    # the limit 0.81 to 0.87 against 0 to 0.02
    assert returns[-5:].mean() > returns[:5].mean() + 1.5
    seen = free._data.observations(torch.arange(0, 240, 5)[None])
    assert free.act(seen)[0, :, 2].mean() < -0.7
    halted = torch.stack([m["actor/halted_share"] for m in run(careful, 40)]).flatten()
    limit = -1.0 - float(careful._detector.threshold) / 2.0  # twice the distance is the threshold
    assert (shifts(free) < limit).float().mean() > 0.6
    assert (shifts(careful) < limit).float().mean() < 0.1
    assert halted[-5:].mean() < halted[:5].mean()


def test_a_halt_that_costs_nothing_is_sought_where_every_reward_is_negative() -> None:
    """The authors' code ends trajectories without a cost: then the unknown is the best place."""
    world = linear_ensemble(LOG, (0.0, 1.0), -1.0)
    sought = in_world(world, beta=3.0, halt_reward=0.0)
    metrics = run(sought, 30)
    halted = torch.stack([m["actor/halted_share"] for m in metrics]).flatten()
    # measured: from a fifth to nine tenths
    assert halted[-5:].mean() > halted[:5].mean() + 0.2
    _, rolled = rolled_out(sought, 1000)
    assert not rolled.ended.rewards[rolled.ended.halts].any()


def test_pretraining_comes_near_the_logged_actions_and_leaves_the_deviations() -> None:
    log = make_log(explore=0.0, episodes=20)
    made = learner("morel", [log], [0], cloning=300, hidden=(16,), learning_rate=1e-2, batch=64)
    assert made.pretraining == 300
    rows = torch.arange(800)[None]

    def distance() -> float:
        acted = made.act(made._data.observations(rows)).detach()
        return float((acted - made._data.actions(rows)).square().mean().sqrt())

    before = distance()
    metrics = run(made, 300)
    assert torch.equal(made._actor.log_std, torch.full((1, 1, 3), -0.25))
    assert {tuple(m) for m in metrics} == {("actor/imitation_error",)}
    assert before > 0.2
    # measured 0.006 to 0.007 with three seeds
    assert distance() < 0.05 * before


def test_pretraining_moves_the_means_alone_and_climbing_policy_and_baseline() -> None:
    made = learner("morel", [LOG], [0])
    for step in range(13):
        before = {k: v.clone() for k, v in made.state_dict().items()}
        made.update(step)
        moved = {
            name.split(".")[0] if "log_std" not in name else "log_std"
            for name, tensor in made.state_dict().items()
            if name not in before or not torch.equal(tensor, before[name])
        }
        climbing = {"actor", "log_std", "critic", "critic_optimizer"}
        assert moved == ({"actor", "actor_optimizer"} if step < 10 else climbing)


def test_the_threshold_belongs_to_the_state() -> None:
    made = learner("morel", [LOG], [0])
    state = {k: v.clone() for k, v in made.state_dict().items()}
    state["detector.threshold"] = torch.tensor([-1.0])
    made.load_state_dict(state)
    assert made.update(10)["actor/halted_share"] == 1.0


def test_deployed_is_the_clipped_mean() -> None:
    made = prepared(0)
    policy = made.policy(policy_card(LOG))
    assert policy.card.kind == "clipped_tanh_layers"
    rows = [0, 7, 39, 100]
    histories = np.stack([history_of(row) for row in rows])
    acted = policy.act(torch.from_numpy(histories)[None])[0]
    expected = np.clip([means(made, 0, scaled(h)) for h in histories], -1.0, 1.0)
    assert (np.abs(expected) == 1.0).any()
    np.testing.assert_allclose(acted, expected, atol=1e-4)  # float32


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trajectories": 0}, "trajectories, horizon and iterations"),
        ({"fisher_samples": 0}, "fisher_samples, hidden and value_hidden must be at least 1"),
        ({"value_hidden": (0,)}, "value_hidden must be at least 1"),
        ({"discount": 1.0}, r"discount must lie in \(0, 1\)"),
        ({"trace": 1.1}, r"trace in \[0, 1\]"),
        ({"damping": 0.0}, "step_size and damping must be positive"),
        ({"cloning": -1}, "cloning and halt_offset must not be negative"),
        ({"halt_offset": -0.1}, "cloning and halt_offset must not be negative"),
        ({"initial_log_std": 1.5}, r"initial_log_std must lie in \[-2, 1\]"),
    ],
)
def test_settings_outside_their_range_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        config("morel", **changes)
