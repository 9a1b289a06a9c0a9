"""LION's losses by plain loops, and its limits in lambda."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from components.algorithms.lion import Config
from components.core.options import identity
from components.data.dynamics import DynamicsSpecification
from components.models.mlp_ensemble.ensemble import MLPTransition
from components.policies.policy import PROXIMITY_SCALING
from tests.components.algorithms.stacks import learner, run
from tests.components.models.transition.test_model_environment import by_loop
from tests.components.synthetic import (
    make_log,
    policy_card,
    random_ensemble,
    random_model,
    random_policy,
)

LOG = make_log()
HISTORY, STEPS = 3, 40


def history_of(row: int) -> np.ndarray:
    """Raw frames ``[H, F]`` of a transition, newest first, gathered one by one."""
    episode, step = divmod(row, STEPS)
    first = episode * (STEPS + 1)
    return np.stack([LOG.frames[first + max(step - lag, 0)] for lag in range(HISTORY)])


def plain_policy(layers: Sequence[tuple], seen: np.ndarray) -> np.ndarray:
    x = seen
    for weight, bias in layers[:-1]:
        x = np.maximum(x @ weight + bias, 0.0)
    weight, bias = layers[-1]
    return np.tanh(x @ weight + bias)


def arrays(layers: Sequence[tuple]) -> list[tuple]:
    return [(w[0].detach().double().numpy(), b[0, 0].detach().double().numpy()) for w, b in layers]


def virtual_trajectory(policy: list, behaviour: list, row: int, proximity: float) -> tuple:
    """Discounted return and mean discounted penalty, acting step by step."""
    mean = LOG.frames.mean(axis=0, dtype=np.float64)
    scale = LOG.frames.std(axis=0, dtype=np.float64)
    scale[0] = 1.0
    ensemble = random_ensemble(LOG, LOG.card.name)
    history, actions, penalties = history_of(row).astype(np.float64), [], []
    start = history_of(row)
    rewards = np.empty(0)
    for _ in range(5):
        seen = ((history - mean) / scale).flatten()
        steered = (proximity - float(PROXIMITY_SCALING.mean)) / float(PROXIMITY_SCALING.scale)
        action = plain_policy(policy, np.append(seen, steered))
        penalties.append(np.square(action - plain_policy(behaviour, seen)).mean())
        actions.append(action)
        # The loop starts over each time: slow, and nothing can be carried over wrongly.
        rewards, frames, _ = by_loop(ensemble, start, np.array(actions))
        history = np.concatenate([frames[-1:], history[:-1]])
    discounts = 0.97 ** np.arange(5)
    return float(discounts @ rewards), float(discounts @ np.array(penalties)) / 5


def test_losses_of_an_update_by_plain_loops() -> None:
    made = learner("lion", [LOG] * 2, [0, 1])
    drawn = {name: value.clone() for name, value in made._streams.at(0).items()}
    before = made.policy(policy_card(LOG, takes_proximity=True))
    metrics = made.update(0)
    behaviour = arrays(random_policy(LOG, ("toy",)).layers)
    for lane in range(2):
        policy = arrays(before.lane(lane, before.card).layers)
        found = [
            virtual_trajectory(policy, behaviour, int(row), float(proximity))
            for row, proximity in zip(drawn["start"][lane], drawn["proximity"][lane], strict=True)
        ]
        returns, penalties = np.array(found).T
        histories = torch.from_numpy(np.stack([history_of(int(r)) for r in drawn["clone"][lane]]))
        zero = torch.zeros(1, len(histories))
        cloned = before.lane(lane, before.card).act(histories[None], zero)[0].numpy()
        logged = LOG.actions[drawn["clone"][lane].numpy()]
        imitation = np.square(cloned - logged).sum(axis=1).mean()
        lam = drawn["proximity"][lane].double().numpy()
        mixed = lam * -returns / 50.0 + (1.0 - lam) * penalties  # the card's mean return is -50
        # float32 through five recurrent steps
        assert float(metrics["policy/virtual_return"][lane]) == pytest.approx(
            returns.mean(), rel=1e-4
        )
        assert float(metrics["policy/penalty"][lane]) == pytest.approx(penalties.mean(), rel=1e-3)
        assert float(metrics["policy/imitation_error"][lane]) == pytest.approx(
            imitation / 3, rel=1e-4
        )
        loss = mixed.mean() + 0.1 * imitation
        assert float(metrics["policy/loss"][lane]) == pytest.approx(loss, rel=1e-3)


def test_the_step_follows_the_gradient_of_that_loss() -> None:
    made = learner("lion", [LOG], [0])
    drawn = {name: value.clone() for name, value in made._streams.at(0).items()}
    bias = made._network.affine()[-1][1]

    def loss() -> float:
        with torch.no_grad():
            returns, penalty = made._virtual_losses(drawn["start"], drawn["proximity"])
            mixed = -drawn["proximity"] * returns + (1 - drawn["proximity"]) * penalty
            return float(mixed.mean() + 0.1 * made._imitation_loss(drawn["clone"]).sum())

    differences = []
    for entry in range(3):
        ends = []
        for sign in (1, -1):
            with torch.no_grad():
                bias[0, 0, entry] += sign * 1e-2
                ends.append(loss())
                bias[0, 0, entry] -= sign * 1e-2
        differences.append((ends[0] - ends[1]) / 2e-2)
    before = bias.detach().clone()
    made.update(0)
    # central differences of a float32 loss near 1, over a step of 0.02
    np.testing.assert_allclose(bias.grad[0, 0], differences, rtol=0.05, atol=1e-4)
    # Adam's first step has the size of the learning rate, against the gradient's sign
    expected = -1e-3 * np.sign(bias.grad[0, 0])
    np.testing.assert_allclose((bias - before).detach()[0, 0], expected, rtol=1e-2)


def test_lambda_follows_its_beta_distribution() -> None:
    made = learner("lion", [LOG], [0], trajectories=2000)
    drawn = made._streams.at(0)["proximity"][0]
    assert drawn.dtype == torch.float32
    assert drawn.min() >= 0.0
    assert drawn.max() <= 1.0
    # Beta(0.1, 0.1): mean 0.5, variance 0.25 / 1.2 = 0.208; five standard errors of 2000 draws
    assert float(drawn.mean()) == pytest.approx(0.5, abs=5 * 0.0102)
    assert float(drawn.var()) == pytest.approx(0.2083, abs=5 * 0.002)


@pytest.mark.parametrize("after", [0, 2])
def test_virtual_trajectories_begin_at_the_beginning(after: int) -> None:
    made = learner("lion", [LOG], [0], trajectories=500, start_window=4, start_after=after)
    starts = made._streams.at(0)["start"][0] % STEPS
    assert sorted(set(starts.tolist())) == list(range(after, 4))
    clones = made._streams.at(0)["clone"][0] % STEPS
    assert len(set(clones.tolist())) == STEPS, "500 draws of 40: a miss has chance 1e-4 a step"


def fix_proximity(made: object, value: float) -> None:
    """Every virtual trajectory gets this lambda."""
    at = made._streams.at  # type: ignore[attr-defined]

    def fixed(step: int) -> dict[str, torch.Tensor]:
        drawn = at(step)
        return drawn | {"proximity": torch.full_like(drawn["proximity"], value)}

    made._streams.at = fixed  # type: ignore[attr-defined]


def distance(made: object, proximity: float) -> float:
    """Mean Euclidean distance to the behaviour policy on all logged states."""
    policy = made.policy(policy_card(LOG, takes_proximity=True))  # type: ignore[attr-defined]
    histories = torch.from_numpy(np.stack([history_of(row) for row in range(LOG.transitions)]))
    lam = torch.full((1, len(histories)), proximity)
    away = policy.act(histories[None], lam) - random_policy(LOG, ("toy",)).act(histories[None])
    return float(away.norm(dim=-1).mean())


@pytest.mark.slow(2)
def test_at_lambda_zero_it_clones_the_behaviour_policy() -> None:
    made = learner("lion", [LOG], [0], learning_rate=5e-3, trajectories=20, hidden=(16,), eta=0.0)
    fix_proximity(made, 0.0)
    before = distance(made, 0.0)
    run(made, 300)
    # measured 0.59 before and 0.05 after
    assert before > 0.4
    assert distance(made, 0.0) < 0.15


@pytest.mark.slow(1)
def test_at_lambda_one_it_follows_the_virtual_return_alone() -> None:
    made = learner("lion", [LOG], [0], learning_rate=5e-3, trajectories=20, hidden=(16,), eta=0.0)
    fix_proximity(made, 1.0)
    metrics = run(made, 150)
    returns = torch.stack([m["policy/virtual_return"][0] for m in metrics])
    # measured -9.7 and then -8.8; the mean of one update's 20 trajectories varies by 0.05
    assert returns[-20:].mean() > returns[:5].mean() + 0.3
    for m in metrics:
        expected = -m["policy/virtual_return"] / 50.0
        torch.testing.assert_close(m["policy/loss"], expected)


@pytest.mark.slow(2)
def test_proximity_steers_one_policy() -> None:
    """After ordinary training, lambda 0 stays closer to the behaviour than lambda 1."""
    made = learner("lion", [LOG], [0], learning_rate=5e-3, trajectories=20, hidden=(16,), eta=0.0)
    run(made, 300)
    # measured 0.06 and 0.79
    assert distance(made, 0.0) < 0.5 * distance(made, 1.0)


def test_returns_can_be_divided_by_something_else_than_the_logs_own() -> None:
    usual, other = (learner("lion", [LOG], [0], return_scale=scale) for scale in (None, 50.0))
    assert other._returns.scale.item() == 50.0
    start, proximity = torch.tensor([[0, 45]]), torch.full((1, 2), 0.5)
    (returns, penalty), (divided, same) = (
        made._virtual_losses(start, proximity) for made in (usual, other)
    )
    own = abs(LOG.card.all_windows_return_mean)
    torch.testing.assert_close(divided * 50.0, returns * own)
    torch.testing.assert_close(penalty, same)


def test_trajectories_may_be_made_in_an_ensemble_without_memory() -> None:
    """Its first reward is the least that a member predicts, clipped as everywhere."""
    made = learner("lion", [LOG], [0], transition="deterministic_ensemble", horizon=1)
    start = torch.tensor([[0, 45]])
    returns, _ = made._virtual_losses(start, torch.full((1, 2), 0.5))
    model = MLPTransition(
        [random_model("deterministic_ensemble", LOG)], made._data.frame_scaling, torch.device("cpu")
    )
    observations, past = made._data.start_states(start, 1)
    dynamics = DynamicsSpecification.of_card(LOG.card)
    actions = made.act(observations, torch.full((1, 2), 0.5))
    known, count = past[:, :, 0].clone(), len(dynamics.known)
    moved = known[..., count - 3 : count] * torch.tensor(dynamics.keep)
    moved = moved + actions * torch.tensor(dynamics.scale)
    known[..., count - 3 : count] = moved.clamp(dynamics.low, dynamics.high)
    scaled = ((known - model.frames.mean) / model.frames.scale)[..., :count]
    own = ((past[:, :, 0] - model.frames.mean) / model.frames.scale)[..., count:]
    predicted, _ = model.predict(
        None, observations[:, None], scaled[:, None], own.transpose(1, 2)[:, :, None]
    )
    values = predicted.values.clamp(model.low[..., None, None], model.high[..., None, None])
    mean, scale = model.frames.mean[0, count:], model.frames.scale[0, count:]
    raw = values * scale[:, None, None] + mean[:, None, None]  # [1, D, K, B]
    rewards = (raw * torch.tensor(dynamics.reward)[:, None, None]).sum(dim=1)
    expected = rewards.amin(dim=1) / abs(LOG.card.all_windows_return_mean)
    torch.testing.assert_close(returns, expected)


def test_the_ensemble_may_be_its_mean_or_its_first_member() -> None:
    """Over one step the mean of the members' rewards, that of the first, by default the least.

    Single members are ensembles of one, whose least reward is their own. The log's range clips each
    of them before the mean is taken, so that the mean of clipped rewards is meant.
    """
    ensemble = random_ensemble(LOG, LOG.card.name)
    start = history_of(0)
    action = np.full((1, 3), 0.25)
    each = []
    for member in range(ensemble.members):
        nets = [member, ensemble.members + member]  # for fatigue and for consumption
        alone = dataclasses.replace(
            ensemble, weight=ensemble.weight[nets], readout=ensemble.readout[nets]
        )
        rewards, _, _ = by_loop(alone, start, action)
        each.append(rewards[0])
    assert len(set(each)) == len(each)
    expected = {"minimum": min(each), "mean": np.mean(each), "single": each[0]}
    for aggregation, reward in expected.items():
        made = learner("lion", [LOG], [0], aggregation=aggregation, horizon=1)
        returned = made._returns.of(
            torch.tensor([[0]]), lambda seen: seen.new_full((*seen.shape[:2], 3), 0.25)
        )
        returned = returned * made._returns.scale
        assert returned.item() == pytest.approx(reward, rel=1e-5)  # float32


def test_an_option_not_taken_is_no_part_of_the_identity() -> None:
    assert "aggregation" not in identity(Config())
    assert identity(Config(aggregation="mean"))["aggregation"] == "mean"
    with pytest.raises(ValueError, match="aggregation must be one of minimum, mean, single"):
        Config(aggregation="median")
