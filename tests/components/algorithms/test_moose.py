"""MOOSE by plain loops, and on machines whose returns are known."""

import dataclasses

import numpy as np
import pytest
import torch

from components.algorithms import moose
from components.algorithms.moose import Config, Learner, mixed_return
from components.core.normaliser import Normaliser
from components.core.random_streams import lane_key
from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification
from components.models.action_vae import ActionVAEConfig, fit_action_vae
from components.models.mlp_ensemble.ensemble import MLPTransition
from components.models.transition.model_environment import ModelEnvironment
from tests.components.algorithms.moose_worlds import (
    LOG,
    MEMBERS,
    OTHER,
    STEPS,
    drawn_for,
    exact_ensemble,
    gradient,
    history_of,
    moose_learner,
    trajectory,
)
from tests.components.algorithms.plain import floats, network, slopes
from tests.components.algorithms.stacks import run, scattered
from tests.components.synthetic import (
    CPU,
    SCALE,
    controller,
    make_log,
    next_outputs,
    policy_card,
    random_model,
)


def test_mixed_returns_by_hand() -> None:
    # two members, three start states: (4, 1), (2, 2), (-3, 5)
    returns = torch.tensor([[[4.0, 2.0, -3.0], [1.0, 2.0, 5.0]]])
    for weight, expected in (
        (0.0, [2.5, 2.0, 1.0]),
        (1.0, [1.0, 2.0, -3.0]),
        (0.5, [1.75, 2.0, -1.0]),
        (0.25, [2.125, 2.0, 0.0]),
    ):
        assert mixed_return(returns, weight).tolist() == [expected]


@pytest.mark.parametrize(
    ("minimum_weight", "return_weight", "discount"), [(0.5, 0.01, 0.97), (0.3, 0.7, 0.6)]
)
def test_an_update_by_plain_loops(
    minimum_weight: float, return_weight: float, discount: float
) -> None:
    """Members roll out in isolation: every trajectory is followed by itself, one after another."""
    logs = (LOG, OTHER)
    made = moose_learner(
        logs,
        (0, 1),
        minimum_weight=minimum_weight,
        return_weight=return_weight,
        penalty_discount=discount,
    )
    scattered(made, 0.3)
    start, _, _, latent = drawn_for(made)
    batch = start.shape[1]
    before = [p.detach().clone() for p in made._actor.parameters()]
    expected: list[tuple[float, ...]] = []
    least_members = []
    for lane, log in enumerate(logs):
        found = np.array(
            [
                [
                    trajectory(made, lane, log, k, int(row), floats(latent)[lane, :, k * batch + b])
                    for b, row in enumerate(start[lane])
                ]
                for k in range(MEMBERS)
            ]
        )  # [K, B, 2]
        returns, penalties = found[..., 0], found[..., 1]
        least = returns.min(axis=0)
        estimate = minimum_weight * least + (1.0 - minimum_weight) * returns.mean(axis=0)
        cost = penalties.mean()
        loss = -return_weight * estimate.mean() + (1.0 - return_weight) * cost
        expected.append((loss, estimate.mean(), returns.mean(), least.mean(), cost))
        least_members.append(set(returns.argmin(axis=0)))
    assert len(least_members[1]) > 1, "the least member must differ among starts"
    metrics = made.update(0)
    names = ("loss", "return_estimate", "virtual_return", "least_virtual_return", "penalty")
    for name, values in zip(names, np.array(expected).T, strict=True):
        # float32 through five steps
        np.testing.assert_allclose(metrics[f"policy/{name}"], values, rtol=1e-4)
    moved = zip(before, made._actor.parameters(), strict=True)
    assert not any(torch.equal(old, new) for old, new in moved)


def test_every_member_goes_on_as_if_it_were_the_only_one() -> None:
    whole = moose_learner()
    _, *past, latent = drawn_for(whole)
    returns, penalty, _ = whole._virtual(whole._parts[0], *past, latent)
    assert returns.shape == penalty.shape == (1, MEMBERS, 4)
    ensemble = random_model("deterministic_ensemble", LOG)
    for k in range(MEMBERS):
        only = dataclasses.replace(
            ensemble, layers=tuple((w[k : k + 1], b[k : k + 1]) for w, b in ensemble.layers),
            elites=(0,),
        )  # fmt: skip
        alone = moose_learner(models={"deterministic_ensemble": only})
        own = latent[:, :, 4 * k : 4 * (k + 1)]
        found = alone._virtual(alone._parts[0], *past, own)
        # float32; other products of matrices
        torch.testing.assert_close(found[0][:, 0], returns[:, k], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(found[1][:, 0], penalty[:, k], rtol=1e-4, atol=1e-6)


def test_known_dynamics_give_the_analytic_return() -> None:
    """The machine's own equations as members: what the policy earns there, and less by what two
    members consume on top."""
    extra = (0.0, 7.0, 30.0)
    made = moose_learner(
        models={"deterministic_ensemble": exact_ensemble(*extra)}, horizon=20, trajectories=5
    )
    # A policy that feels the steerings, so that trajectories are told apart by more than starts.
    scattered(made, 0.3)
    start, *given = drawn_for(made)
    returns, _, _ = made._virtual(made._parts[0], *given)
    mean, scale = (
        floats(t)[0] for t in (made._data.frame_scaling.mean, made._data.frame_scaling.scale)
    )
    for b, row in enumerate(start[0].tolist()):
        for k, more in enumerate(extra):
            frames, total = history_of(LOG, row), 0.0
            for t in range(20):
                action = np.tanh(network(made._actor, 0, ((frames - mean) / scale).reshape(1, -1)))
                steering = np.clip(frames[:1, 1:4] + SCALE * action, 0.0, 100.0)
                outputs = next_outputs(steering, frames[:1, 4]) + np.array([0.0, more])
                total += 0.97**t * (-0.03 * outputs[0, 0] - 0.01 * outputs[0, 1])
                newest = np.concatenate([[70.0], steering[0], outputs[0]])
                frames = np.vstack([newest, frames[:-1]])
            # twenty float32 steps
            assert returns[0, k, b].item() == pytest.approx(total, rel=1e-4)


def in_double(made: Learner) -> None:
    """Let a learner of one lane compute in double precision."""
    [part] = made._parts
    ensemble = random_model("deterministic_ensemble", LOG)
    scaling = Normaliser(
        *(t.double() for t in (made._data.frame_scaling.mean, made._data.frame_scaling.scale))
    )
    ensemble = dataclasses.replace(
        ensemble,
        layers=tuple((w.double(), b.double()) for w, b in ensemble.layers),
        frames=Normaliser(ensemble.frames.mean.double(), ensemble.frames.scale.double()),
        **{
            n: getattr(ensemble, n).double() for n in ("low", "high", "target_mean", "target_scale")
        },
    )
    environment = ModelEnvironment(
        MLPTransition([ensemble], scaling, CPU),
        DynamicsSpecification.of_card(LOG.card),
        scaling,
        CPU,
    )
    part.reconstruct._network.double()
    part.actor.double()
    made._parts = [dataclasses.replace(part, environment=environment)]


def test_gradient_of_the_loss_by_central_differences() -> None:
    made = moose_learner(hidden=(5,), return_weight=0.4)
    scattered(made, 0.3)
    in_double(made)
    _, *given = (t.double() for t in drawn_for(made))
    [part] = made._parts
    parameters = list(part.actor.parameters())
    loss, _ = made._loss(part, *given)
    for found, parameter in zip(
        torch.autograd.grad(loss.sum(), parameters), parameters, strict=True
    ):
        numbers = parameter.data.view(-1)  # the parameter's own memory

        def value() -> float:
            with torch.no_grad():
                return made._loss(part, *given)[0].item()

        # double precision; a step of 1e-6 across no kink of the small networks
        np.testing.assert_allclose(found.flatten(), slopes(value, numbers), rtol=1e-4, atol=1e-7)
        assert found.abs().max() > 1e-3


def test_plain_gradient_descent_is_exact() -> None:
    made = moose_learner(learning_rate=0.01)
    for step in range(3):
        expected = gradient(made, step)
        before = [p.detach().clone() for p in made._actor.parameters()]
        made.update(step)
        for old, new, slope in zip(before, made._actor.parameters(), expected, strict=True):
            assert torch.equal(new, old.add(slope, alpha=-0.01))
            assert slope.abs().max() > 0
    assert not any("optimizer" in name for name in made.state_dict()), "it remembers nothing"


def test_adam_is_an_option() -> None:
    made = moose_learner(optimizer="adam", learning_rate=1e-3)
    slopes_of, before = gradient(made), [p.detach().clone() for p in made._actor.parameters()]
    made.update(0)
    for old, new, slope in zip(before, made._actor.parameters(), slopes_of, strict=True):
        felt = slope.abs() > 1e-4
        assert felt.any()
        # Adam's first step has the size of the learning rate, against the gradient's sign
        moved = (new - old).detach()[felt]
        torch.testing.assert_close(moved, -1e-3 * slope[felt].sign(), rtol=1e-2, atol=1e-6)
    assert any("optimizer" in name for name in made.state_dict())


@pytest.mark.parametrize("at_once", [2, 3])
def test_parts_of_a_stack_change_nothing(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    logs, seeds = (LOG, OTHER, LOG), (0, 1, 2)
    by_lane = moose_learner(logs, seeds)
    monkeypatch.setitem(moose.LANES_AT_ONCE, "cpu", at_once)
    by_part = moose_learner(logs, seeds)
    assert (len(by_lane._parts), len(by_part._parts)) == (3, -(-3 // at_once))
    for ours, theirs in zip(run(by_part, 10), run(by_lane, 10), strict=True):
        for name, value in theirs.items():
            # products of three lanes at once may sum in another order
            torch.testing.assert_close(ours[name], value, rtol=1e-5, atol=1e-6)
    for one, other in zip(by_part._actor.parameters(), by_lane._actor.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


def test_a_lane_of_a_stack_is_the_lane_alone_bit_for_bit() -> None:
    """On a processor, where lanes are computed one after another."""
    stack, alone = moose_learner((OTHER, LOG), (0, 1)), moose_learner((LOG,), (1,))
    for many, one in zip(run(stack, 20), run(alone, 20), strict=True):
        for name, value in one.items():
            assert torch.equal(many[name][1:], value)
    for whole, own in zip(stack._actor.parameters(), alone._actor.parameters(), strict=True):
        assert torch.equal(whole[1:], own)


def test_start_states_come_from_the_whole_log() -> None:
    starts = moose_learner(trajectories=500)._streams.at(0)["start"][0]
    assert starts.min() >= 0
    assert starts.max() < LOG.transitions
    # 500 of 240: a step of 40 is missed with chance 40 (1 - 1/40)^500 = 1e-4; seeds are fixed
    assert len(set((starts % STEPS).tolist())) == STEPS


def test_models_stay_as_they_were_fitted() -> None:
    made = moose_learner()
    [part] = made._parts
    frozen = [p for p in part.reconstruct._network.parameters()]
    kept = [p.clone() for p in frozen]
    run(made, 5)
    assert all(torch.equal(now, then) for now, then in zip(frozen, kept, strict=True))
    assert all(p.grad is None for p in frozen)
    assert set(made.state_dict()) == {
        f"policy.layers.{n}.{part}" for n in (0, 1) for part in ("weight", "bias")
    }


def test_the_share_of_saturated_actions_is_logged() -> None:
    made = moose_learner()
    assert made.update(0)["policy/saturated_share"].tolist() == [0.0]
    with torch.no_grad():
        made._actor.affine()[-1][1].copy_(torch.tensor([9.0, -9.0, 0.0]))
    # two of three entries are on their bounds
    assert made.update(1)["policy/saturated_share"].item() == pytest.approx(2 / 3)


def chosen_by(made: Learner, log: OfflineDataset = LOG) -> np.ndarray:
    """Deployed actions ``[N, A]`` in all logged states."""
    histories = np.stack([history_of(log, row) for row in range(log.transitions)])
    policy = made.policy(policy_card(log))
    return policy.act(torch.from_numpy(histories).float()[None])[0].numpy()


@pytest.mark.slow(2)
def test_it_may_begin_as_a_clone() -> None:
    log = make_log(explore=0.0)
    logged = controller(log.frames[log.frame_rows()][:, 1:4].astype(np.float64))
    away, made = [], moose_learner((OTHER, log), (1, 0), cloning=300, hidden=(32,))
    assert made.pretraining == 300
    for cloning in (0, 300):
        alone = moose_learner((log,), cloning=cloning, hidden=(32,))
        for metrics in run(alone, cloning):
            assert set(metrics) == {"policy/imitation_error"}
        away.append(float(np.square(chosen_by(alone, log) - logged).mean()))
    assert away[1] < 0.1 * away[0]  # measured 0.22 and then 0.001
    run(made, 300)
    for whole, own in zip(made._actor.parameters(), alone._actor.parameters(), strict=True):
        # three hundred steps of Adam, side by side and alone
        torch.testing.assert_close(whole[1:], own, rtol=1e-2, atol=1e-3)
    # What follows is the update without cloning, with its draws, from where cloning has ended.
    usual = moose_learner((log,), hidden=(32,))
    usual._networks["policy"].load_state_dict(alone._networks["policy"].state_dict())
    [after], [plain] = run(alone, 1, 300), run(usual, 1)
    for name, value in plain.items():
        assert torch.equal(after[name], value)


@pytest.mark.slow(1)
def test_without_the_penalty_the_return_is_climbed() -> None:
    """Everything low pays: velocity wears and consumes, gain consumes, and what a unit of shift
    saves in consumption, 0.01 * 0.3, is less than it wears in the long run, 0.03 * 0.1 / (1 - 0.6).
    """
    made = moose_learner(
        models={"deterministic_ensemble": exact_ensemble(0.0, 4.0)},
        return_weight=1.0, learning_rate=0.05, hidden=(16,), trajectories=20, horizon=10,
    )  # fmt: skip
    metrics = run(made, 60)
    for values in metrics:
        assert torch.equal(values["policy/loss"], -values["policy/return_estimate"])
    returns = torch.stack([m["policy/virtual_return"][0] for m in metrics])
    # measured -15.6 and then -13.2; other seeds rise by 2.5; an update's mean varies by 0.7
    assert returns[-5:].mean() > returns[:5].mean() + 1.0
    # measured means -0.93, -0.96 and -0.92
    assert (chosen_by(made).mean(axis=0) < -0.7).all()


@pytest.mark.slow(3)
def test_the_penalty_alone_draws_the_policy_to_the_logged_actions() -> None:
    log = make_log(episodes=20, steps=60, explore=0.0)
    settings = ActionVAEConfig(hidden=(32, 32), epochs=30, batch=64, learning_rate=3e-3)
    autoencoder = fit_action_vae(log, settings, lane_key("penalty"), CPU).model
    made = moose_learner(
        (log,),
        models={"deterministic_ensemble": exact_ensemble(0.0, 1.0), "action_vae": autoencoder},
        return_weight=0.0, learning_rate=0.015, hidden=(32,), trajectories=20, horizon=10,
    )  # fmt: skip
    frames = log.frames[log.frame_rows()]
    histories = made._data.raw_histories(torch.arange(log.transitions)[None])
    logged = controller(frames[:, 1:4].astype(np.float64))

    def distance() -> float:
        actions = made.policy(policy_card(log)).act(histories)[0].numpy()
        return float(np.square(actions - logged).mean())

    away = distance()
    metrics = run(made, 150)
    for values in metrics:
        assert torch.equal(values["policy/loss"], values["policy/penalty"])
    penalties = torch.stack([m["policy/penalty"][0] for m in metrics])
    # three seeds measured: 0.59 to 2.4 and then 0.003 to 0.006
    assert penalties[-5:].mean() < 0.1 * penalties[:5].mean()
    # measured 0.10 to 0.11 and then 0.002 to 0.003
    assert distance() < 0.1 * away


@pytest.mark.parametrize(
    ("weight", "name"), [(1.0, "least_virtual_return"), (0.0, "virtual_return")]
)
def test_ends_of_the_mixture(weight: float, name: str) -> None:
    metrics = moose_learner(minimum_weight=weight).update(0)
    # float32 means of the same numbers
    torch.testing.assert_close(metrics["policy/return_estimate"], metrics[f"policy/{name}"])
    assert metrics["policy/least_virtual_return"] < metrics["policy/virtual_return"]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("updates", 0),
        ("hidden", (400, 0)),
        ("trajectories", 0),
        ("horizon", 0),
        ("learning_rate", 0.0),
        ("discount", 1.1),
        ("penalty_discount", 0.0),
        ("return_weight", -0.1),
        ("return_weight", 1.1),
        ("minimum_weight", 1.5),
        ("optimizer", "adamw"),
    ],
)
def test_values_out_of_range_are_refused(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=rf"{field}.*\.$"):
        Config(**{field: value})


def test_lanes_need_their_models() -> None:
    with pytest.raises(ValueError, match="1 lanes need as many ActionVAE as 'action_vae'"):
        moose_learner(models={"action_vae": random_model("behaviour_policy", LOG)})
