"""Virtual trajectories on hand-made ensembles, against plain loops."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.data.dynamics import DynamicsSpecification
from components.models.mlp_ensemble.ensemble import MLPTransition
from components.models.recurrent_ensemble.ensemble import RecurrentEnsemble
from components.models.recurrent_ensemble.transition import RecurrentTransition
from components.models.transition.model_environment import (
    ModelEnvironment,
    PredictionRange,
    discounted_sum,
)
from tests.components.synthetic import (
    CPU,
    FATIGUE_ALONE,
    SCALE,
    make_log,
    random_ensemble,
    random_mlp_ensemble,
)

LOG = make_log()
RULE = DynamicsSpecification.of_card(LOG.card)
PLAIN = Normaliser(torch.zeros(6), torch.ones(6))
HISTORY = torch.from_numpy(LOG.frames[:12].reshape(1, 4, 3, 6).copy())  # [L, B, H, F]
SEEN = HISTORY.flatten(2)  # as policies see them in the plain scaling


def constant_ensemble(
    fatigue: Sequence[float], consumption: Sequence[float], low: float = -9.0, high: float = 9.0
) -> RecurrentEnsemble:
    """Members that predict fixed normalised values, by the bias of their readings."""
    members, width = len(fatigue), 2
    readout = torch.zeros(2 * members, 1, width + 1)
    readout[:, 0, -1] = torch.tensor([*fatigue, *consumption])
    scaling = Normaliser(
        torch.tensor([70.0, 50.0, 50.0, 50.0, 40.0, 100.0]), torch.tensor([1.0, 9, 9, 9, 4.0, 8.0])
    )
    weight = torch.zeros(2 * members, width, width + 6)
    return RecurrentEnsemble(
        weight,
        readout,
        scaling,
        torch.full((2,), low),
        torch.full((2,), high),
        FATIGUE_ALONE,
        warm_up=3,
    )


def machine(*ensembles: RecurrentEnsemble) -> ModelEnvironment:
    scaling = Normaliser.stack([PLAIN] * len(ensembles))
    return ModelEnvironment(RecurrentTransition(ensembles, CPU), RULE, scaling, CPU)


def watched(virtual: ModelEnvironment, actions: Tensor, history: Tensor = HISTORY) -> tuple:
    """Rewards, and all observations the policy was shown, under actions ``[T, A]``."""
    seen: list[Tensor] = []

    def act(observation: Tensor) -> Tensor:
        seen.append(observation.detach())
        return actions[len(seen) - 1].expand(*observation.shape[:2], -1)

    rewards = torch.stack(
        [s.rewards for s in virtual.unroll(history.flatten(2), history, act, len(actions))]
    )
    return rewards, torch.stack(seen)


def test_steerings_follow_exactly_and_clip() -> None:
    actions = torch.cat([torch.ones(9, 3), -torch.ones(15, 3)])
    _, seen = watched(machine(constant_ensemble([0.0], [0.0])), actions)
    expected = LOG.frames[[0, 3, 6, 9], 1:4].astype(np.float64)
    for t in range(23):
        expected = np.clip(expected + SCALE * actions[t].numpy(), 0.0, 100.0)
        # float32 additions of numbers near 100
        np.testing.assert_allclose(seen[t + 1, 0, :, 1:4], expected, atol=1e-4)
        assert (seen[t + 1, 0, :, 0] == 70.0).all()
    assert expected[:, 1].min() == 0.0, "the gain, the fastest, must have reached its end"


def test_histories_move_by_one_frame() -> None:
    _, seen = watched(machine(constant_ensemble([0.5], [0.25])), torch.zeros(3, 3))
    assert torch.equal(seen[0, 0], HISTORY[0].flatten(1))
    assert torch.equal(seen[1, 0, :, 6:], HISTORY[0, :, :2].flatten(1))
    assert torch.equal(seen[2, 0, :, 12:], HISTORY[0, :, 0])
    assert (seen[1, 0, :, 4] == 40.0 + 0.5 * 4.0).all()
    assert (seen[1, 0, :, 5] == 100.0 + 0.25 * 8.0).all()


def test_the_member_of_lowest_reward_is_followed() -> None:
    # raw fatigue 40 + 4 z, raw consumption 100 + 8 z; rewards -2.20, -2.24 (lowest), -2.18
    ensemble = constant_ensemble([0.0, 1.0, -1.0], [0.0, -1.0, 1.25])
    rewards, seen = watched(machine(ensemble), torch.zeros(4, 3))
    by_hand = [
        -0.03 * (40 + 4 * f) - 0.01 * (100 + 8 * c) for f, c in ((0, 0), (1, -1), (-1, 1.25))
    ]
    assert min(by_hand) == by_hand[1] == pytest.approx(-2.24)
    assert rewards.shape == (4, 1, 4)
    torch.testing.assert_close(rewards, torch.full((4, 1, 4), -2.24))
    assert (seen[1:, 0, :, 4] == 44.0).all()
    assert (seen[1:, 0, :, 5] == 92.0).all(), "fatigue and consumption of the same member"


def test_predictions_are_clipped_to_the_known_range() -> None:
    rewards, seen = watched(
        machine(constant_ensemble([5.0, 3.0], [-7.0, -6.0], low=-2.0, high=1.5)), torch.zeros(2, 3)
    )
    assert (seen[1, 0, :, 4] == 46.0).all()
    assert (seen[1, 0, :, 5] == 84.0).all()
    torch.testing.assert_close(rewards, torch.full((2, 1, 4), -0.03 * 46.0 - 0.01 * 84.0))


@pytest.mark.parametrize(
    ("limits", "fatigue", "consumption"), [("data", 46.0, 84.0), ("free", 60.0, 44.0)]
)
def test_clipping_is_an_option_and_steps_tell_what_was_drawn(
    limits: PredictionRange, fatigue: float, consumption: float
) -> None:
    ensemble = constant_ensemble([5.0], [-7.0], low=-2.0, high=1.5)
    scaling = Normaliser.stack([PLAIN])
    transition = RecurrentTransition([ensemble], CPU)
    virtual = ModelEnvironment(transition, RULE, scaling, CPU, limits)
    for step in virtual.unroll(SEEN, HISTORY, lambda seen: torch.zeros(1, 4, 3), 3):
        # 40 + 4 z and 100 + 8 z, exact in float32
        assert step.frames[0, :, 4:].tolist() == [[fatigue, consumption]] * 4
        assert step.drawn[0, :, 0].tolist() == [[5.0] * 4, [-7.0] * 4]
        torch.testing.assert_close(
            step.rewards, torch.full((1, 4), -0.03 * fatigue - 0.01 * consumption)
        )


def by_loop(ensemble: RecurrentEnsemble, history: np.ndarray, actions: np.ndarray) -> tuple:
    """One trajectory, member by member, in double precision: rewards, frames and choices."""
    weight, readout = ensemble.weight.double().numpy(), ensemble.readout.double().numpy()
    mean, scale = ensemble.frames.mean.double().numpy(), ensemble.frames.scale.double().numpy()
    low, high = ensemble.low.double().numpy(), ensemble.high.double().numpy()
    members, width = ensemble.members, weight.shape[1]
    scaled = (history[::-1].astype(np.float64) - mean) / scale  # oldest first
    hidden = np.zeros((2 * members, width))

    def advance(inputs: np.ndarray, own: float) -> np.ndarray:
        predicted = np.empty(2 * members)
        for m in range(2 * members):
            fed = own if m < members else 0.0
            hidden[m] = np.tanh(weight[m] @ np.concatenate([hidden[m], inputs, [fed, 1.0]]))
            predicted[m] = readout[m, 0] @ np.append(hidden[m], 1.0)
        return predicted.reshape(2, members)

    for before, after in itertools.pairwise(scaled):
        advance(after[:4], before[4])
    frame = history[0].astype(np.float64)
    own = scaled[-1, 4]
    rewards, frames, choices = [], [], []
    for action in actions:
        steering = np.clip(frame[1:4] + SCALE * action, 0.0, 100.0)
        inputs = (np.concatenate([frame[:1], steering]) - mean[:4]) / scale[:4]
        predicted = np.clip(advance(inputs, own), low[:, None], high[:, None])
        raw = predicted * scale[4:, None] + mean[4:, None]
        reward = -0.03 * raw[0] - 0.01 * raw[1]
        choice = int(reward.argmin())
        own = predicted[0, choice]
        frame = np.concatenate([frame[:1], steering, raw[:, choice]])
        rewards.append(reward[choice])
        frames.append(frame)
        choices.append(choice)
    return np.array(rewards), np.array(frames), choices


def test_members_keep_their_own_hidden_states_after_warming_up_on_the_record() -> None:
    """Recorded frames first, then own predictions: a plain loop gives the same numbers."""
    ensembles = [random_ensemble(LOG, name) for name in "ab"]
    history = torch.from_numpy(LOG.frames[:60].reshape(2, 5, 6, 6).copy())
    actions = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (12, 3))).float()
    rewards, seen = watched(machine(*ensembles), actions, history)
    chosen = set()
    for lane, b in itertools.product(range(2), range(5)):
        expected, frames, choices = by_loop(
            ensembles[lane], history[lane, b].numpy(), actions.double().numpy()
        )
        chosen |= {(lane, choice) for choice in choices}
        # twelve recurrent steps in float32
        np.testing.assert_allclose(rewards[:, lane, b], expected, rtol=1e-4)
        np.testing.assert_allclose(seen[1:, lane, b, :6], frames[:-1], rtol=1e-4, atol=1e-3)
    assert len(chosen) >= 4, "the choice must vary for this test to say something"


def test_gradients_flow_through_time() -> None:
    ensemble = random_ensemble(LOG, "g")
    ensemble = dataclasses.replace(
        ensemble,
        weight=ensemble.weight.double(),
        readout=ensemble.readout.double(),
        frames=Normaliser(ensemble.frames.mean.double(), ensemble.frames.scale.double()),
        low=ensemble.low.double() - 9.0,
        high=ensemble.high.double() + 9.0,
    )
    scaling = Normaliser(PLAIN.mean.double()[None], PLAIN.scale.double()[None])
    virtual = ModelEnvironment(RecurrentTransition([ensemble], CPU), RULE, scaling, CPU)
    matrix = 0.01 * torch.randn(18, 3, generator=torch.Generator().manual_seed(0)).double()
    discounts = 0.9 ** torch.arange(8).double()

    def total(weights: Tensor) -> Tensor:
        steps = virtual.unroll(
            SEEN.double(),
            HISTORY.double(),
            lambda seen: torch.tanh((seen - 50.0) @ weights / 10.0),
            8,
        )
        rewards = torch.stack([step.rewards for step in steps])
        return (discounts[:, None, None] * rewards).sum()

    weights = matrix.requires_grad_()
    [gradient] = torch.autograd.grad(total(weights), weights)
    assert gradient.abs().max() > 0
    direction = torch.randn(18, 3, generator=torch.Generator().manual_seed(1)).double()
    step = 1e-6
    with torch.no_grad():
        rise = total(weights + step * direction) - total(weights - step * direction)
    # central difference in double precision; a change of the chosen member would show as a jump
    assert float(rise / (2 * step)) == pytest.approx(float((gradient * direction).sum()), rel=1e-5)


@pytest.mark.parametrize("kind", ["recurrent", "gaussian"])
@pytest.mark.parametrize("propagation", ["minimum", "mean", "isolated", "numbers"])
def test_without_gradients_the_steps_are_the_same(kind: str, propagation: str) -> None:
    """Also after later ones have been made: what a step shows is not overwritten."""
    model = random_ensemble if kind == "recurrent" else random_mlp_ensemble
    ensembles = [model(LOG, name) for name in "ab"]
    scaling = Normaliser.stack([Normaliser.fit(LOG.frames)] * 2)
    transition = (
        RecurrentTransition(ensembles, CPU)
        if kind == "recurrent"
        else MLPTransition(ensembles, scaling, CPU)
    )
    virtual = ModelEnvironment(transition, RULE, scaling, CPU)
    history = torch.from_numpy(LOG.frames[:60].reshape(2, 10, 3, 6).copy())
    seen_first = ((history - scaling.mean[:, None, None]) / scaling.scale[:, None, None]).flatten(2)
    generator = torch.Generator().manual_seed(0)
    matrix = 0.3 * torch.randn(2, 18, 3, generator=generator)
    chosen = torch.randint(3, (12, 2, 10), generator=generator)
    which = chosen if propagation == "numbers" else propagation

    def act(seen: Tensor) -> Tensor:
        return torch.tanh(seen @ matrix)

    recorded = list(virtual.unroll(seen_first, history, act, 12, which))
    copies = 3 if propagation == "isolated" else 1
    begun = transition.begin(history[:, None].expand(-1, copies, -1, -1, -1))
    with torch.no_grad():
        plain = list(virtual.unroll(seen_first, history, act, 12, which))
        continued = list(virtual.unroll(seen_first, history, act, 12, which, state=begun))
        again = list(virtual.unroll(seen_first, history, act, 12, which, state=begun))
    for number, step in enumerate(recorded):
        for other in (plain[number], continued[number], again[number]):
            for name in ("observations", "actions", "rewards", "frames", "drawn"):
                ours, theirs = getattr(other, name), getattr(step, name)
                torch.testing.assert_close(ours, theirs)  # the same kernels on other strides
            torch.testing.assert_close(other.prediction.values, step.prediction.values)
    shown = {tuple(step.observations[0, 0, :6].tolist()) for step in plain}
    assert len(shown) == 12, "the frames must differ for this test to say something"


def test_of_equally_low_rewards_the_first_member_is_followed() -> None:
    # Clipped to 1, the last three are equally bad; what is drawn is not clipped.
    virtual = machine(constant_ensemble([0.0, 3.0, 4.0, 2.0], [0.0, 6.0, 5.0, 7.0], -1.0, 1.0))
    [step] = virtual.unroll(SEEN, HISTORY, lambda seen: seen.new_zeros(*seen.shape[:2], 3), 1)
    assert step.drawn[0, :, 0].tolist() == [[3.0] * 4, [6.0] * 4]


def test_the_mean_of_the_members_has_the_mean_of_their_rewards() -> None:
    # Of fatigues 0, 1 and 5, the last clipped to 1.5, and consumptions 0, -1 and 4, likewise.
    virtual = machine(constant_ensemble([0.0, 1.0, 5.0], [0.0, -1.0, 4.0], -2.0, 1.5))
    members = [(0.0, 0.0), (1.0, -1.0), (1.5, 1.5)]
    rewards = [-0.03 * (40 + 4 * f) - 0.01 * (100 + 8 * c) for f, c in members]
    for step in virtual.unroll(
        SEEN, HISTORY, lambda seen: seen.new_zeros(*seen.shape[:2], 3), 3, "mean"
    ):
        torch.testing.assert_close(step.rewards, torch.full((1, 4), sum(rewards) / 3))
        fatigue, consumption = np.mean(members, axis=0)
        expected = torch.tensor([40 + 4 * fatigue, 100 + 8 * consumption]).float()
        torch.testing.assert_close(step.frames[0, :, 4:], expected.expand(4, 2))


def test_return_rises_where_less_is_consumed() -> None:
    # One member whose consumption grows with the velocity: lowering the velocity pays.
    ensemble = constant_ensemble([0.0], [0.0])
    ensemble.weight[1, 0, 2 + 1] = 0.5  # velocity into the first hidden unit
    ensemble.readout[1, 0, 0] = 2.0
    action = torch.zeros(3, requires_grad=True)
    steps = machine(ensemble).unroll(SEEN, HISTORY, lambda seen: action.expand(1, 4, 3), 5)
    torch.stack([step.rewards for step in steps]).sum().backward()
    assert action.grad[0] < 0
    assert action.grad[1:].tolist() == [0.0, 0.0]


def test_lanes_do_not_feel_each_other() -> None:
    ensembles = [random_ensemble(LOG, name) for name in "abc"]
    history = torch.from_numpy(LOG.frames[:90].reshape(3, 5, 6, 6).copy())
    actions = torch.zeros(6, 3)
    together, _ = watched(machine(*ensembles), actions, history)
    for lane, ensemble in enumerate(ensembles):
        alone, _ = watched(machine(ensemble), actions, history[lane : lane + 1])
        torch.testing.assert_close(together[:, lane], alone[:, 0])


def test_cards_must_tell_how_actions_move_the_machine() -> None:
    assert RULE.scale == tuple(SCALE)
    assert RULE.reward == (-0.03, -0.01)
    known = {"features": ["setpoint"], "keep": [1.0], "scale": [0.0]}
    card = dataclasses.replace(LOG.card, dynamics={"known": known, "learned": []})
    with pytest.raises(ValueError, match="card of toy lacks 'low' in its dynamics specification"):
        DynamicsSpecification.of_card(card)


def alone(ensemble: RecurrentEnsemble, member: int) -> RecurrentEnsemble:
    """An ensemble of one of the members."""
    pair = [member, ensemble.members + member]
    return dataclasses.replace(
        ensemble, weight=ensemble.weight[pair], readout=ensemble.readout[pair]
    )


def by_velocity(observation: Tensor) -> Tensor:
    """A policy that reacts to the newest frame, so that copies drift apart."""
    return torch.tanh((observation[..., 1:6] - 50.0) @ torch.eye(5, 3) / 10.0)


def test_isolated_members_continue_their_own_copies() -> None:
    """Member k's copies are the trajectories of a machine that has no other member."""
    ensembles = [random_ensemble(LOG, name, members=3) for name in "ab"]
    history = HISTORY.expand(2, -1, -1, -1)
    steps = list(
        machine(*ensembles).unroll(history.flatten(2), history, by_velocity, 6, "isolated")
    )
    assert steps[0].observations.shape == (2, 3 * 4, 18)
    for member in range(3):
        own = machine(*(alone(e, member) for e in ensembles)).unroll(
            history.flatten(2), history, by_velocity, 6
        )
        for step, expected in zip(steps, own, strict=True):
            for name in ("observations", "actions", "rewards", "frames"):
                found = getattr(step, name).unflatten(1, (3, 4))[:, member]
                torch.testing.assert_close(found, getattr(expected, name))
    spread = steps[-1].rewards.unflatten(1, (3, 4)).std(dim=1)
    assert (spread > 0).all(), "members agree, and the test shows nothing"


def test_one_member_followed_throughout_is_that_member_in_isolation() -> None:
    ensemble = random_ensemble(LOG, "c", members=3)
    isolated = list(machine(ensemble).unroll(SEEN, HISTORY, by_velocity, 5, "isolated"))
    members = torch.tensor([2, 0, 1, 2])
    followed = machine(ensemble).unroll(SEEN, HISTORY, by_velocity, 5, members.expand(5, 1, 4))
    for step, copies in zip(followed, isolated, strict=True):
        found = copies.frames.unflatten(1, (3, 4))[0, members, torch.arange(4)]
        torch.testing.assert_close(step.frames[0], found)


def test_members_may_change_from_step_to_step() -> None:
    ensemble = constant_ensemble([0.0, 1.0, -1.0], [0.0, -1.0, 1.25])
    members = torch.tensor([[[0, 1, 2, 0]], [[2, 2, 1, 0]]])
    steps = list(
        machine(ensemble).unroll(SEEN, HISTORY, lambda seen: seen[..., :3] * 0, 2, members)
    )
    fatigue = torch.tensor([40.0, 44.0, 36.0])
    for step, chosen in zip(steps, members, strict=True):
        assert torch.equal(step.frames[0, :, 4], fatigue[chosen[0]])


def test_noise_does_nothing_to_members_without_a_spread() -> None:
    ensemble = random_ensemble(LOG, "d")
    noise = torch.randn(3, 1, 2, 4, generator=torch.Generator().manual_seed(0))
    plain = machine(ensemble).unroll(SEEN, HISTORY, by_velocity, 3)
    noisy = machine(ensemble).unroll(SEEN, HISTORY, by_velocity, 3, noise=noise)
    for first, second in zip(plain, noisy, strict=True):
        assert torch.equal(first.rewards, second.rewards)


def test_discounted_sum_by_hand() -> None:
    rewards = [torch.tensor([1.0, 2.0]), torch.tensor([4.0, 0.0]), torch.tensor([8.0, 4.0])]
    assert discounted_sum(rewards, 0.5).tolist() == [1 + 2 + 2, 2 + 0 + 1]
