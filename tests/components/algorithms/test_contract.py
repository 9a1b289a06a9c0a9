"""What every algorithm owes: shapes, bounds, finite metrics, policies that can be stored.

In two worlds: a machine that shows padded histories and never ends, and a robot that falls.
"""

from pathlib import Path
from typing import Any

import pytest
import torch

from components.algorithms import ALGORITHMS
from components.algorithms.parts.learner import LearnerInputs, first_rows
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.models import MODELS
from components.policies.policy import Policy
from tests.components.algorithms.stacks import graded, learner, run
from tests.components.robot import make_robot_log
from tests.components.synthetic import CPU, make_log, policy_card, relabelled

LOG = make_log()
every_algorithm = pytest.mark.parametrize("name", ALGORITHMS)
in_every_world = pytest.mark.parametrize("log", [LOG, make_robot_log()], ids=lambda d: d.card.name)
WITHOUT_CRITICS = ("bc", "rvs", "lion", "moose", "model_based", "wsbc")


def candidate_noise(policy: Policy, batch: int) -> torch.Tensor | None:
    """What a policy that draws candidates is given."""
    if not policy.card.candidates:
        return None
    shape = (policy.lanes, batch, policy.card.candidates, policy.card.noise)
    return torch.randn(shape, generator=torch.Generator().manual_seed(1))


def inside(made: Any, observations: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
    """What the learner's own networks would do, at lambda from 0 to 1 where there is one."""
    if ALGORITHMS_BY_LEARNER[type(made)].TAKES_LAMBDA:
        return made._act(observations, torch.linspace(0, 1, observations.shape[1])[None])
    if hasattr(made, "_swarm"):
        return made._act(made._layers(made._swarm.best[:, None]), observations)
    if hasattr(made, "_detector"):
        return made._act(observations)
    if noise is None:
        out = made._actor(observations)
        return torch.tanh(out[0] if isinstance(out, tuple) else out)
    if hasattr(made._actor, "draw"):
        actions = made._actor.draw(made._actor(observations), noise)[0]
    else:
        actions = made._perturb(made._actor, observations, made._generate(observations, noise))
    best = made._critics.over_actions(observations, actions)[:, 0].argmax(dim=-1)
    rows = torch.arange(observations.shape[1])
    return actions[0, rows, best[0]][None]


ALGORITHMS_BY_LEARNER = {module.Learner: module for module in ALGORITHMS.values()}


@every_algorithm
def test_module_offers_the_outline(name: str) -> None:
    module = ALGORITHMS[name]
    assert set(module.NEEDS) <= set(MODELS)
    assert isinstance(module.TAKES_LAMBDA, bool)
    assert module.VERSION >= 1
    assert module.FRAME_EPSILON >= 0.0
    assert module.Config().updates >= 1


@in_every_world
@every_algorithm
def test_metrics_are_finite_and_one_per_lane(name: str, log: OfflineDataset) -> None:
    made = learner(name, [log] * 3, range(3))
    assert made.lanes == 3
    for metrics in run(made, 8):
        assert metrics
        for value in metrics.values():
            assert value.shape == (3,)
            assert value.isfinite().all()
            assert not value.requires_grad


@in_every_world
@every_algorithm
def test_policies_act_within_bounds_and_survive_storage(
    name: str, log: OfflineDataset, tmp_path: Path
) -> None:
    takes_lambda = ALGORITHMS[name].TAKES_LAMBDA
    has_rate = hasattr(ALGORITHMS[name].Config, "learning_rate")
    made = learner(name, [log] * 2, range(2), **({"learning_rate": 0.03} if has_rate else {}))
    run(made, 20)
    policy = made.policy(policy_card(log, takes_lambda=takes_lambda))
    assert policy.lanes == 2
    shape = (2, 9, log.card.history, len(log.card.frame_features))
    histories = 50.0 * torch.randn(shape, generator=torch.Generator().manual_seed(0))
    proximity = torch.linspace(0, 1, 9).expand(2, -1) if takes_lambda else None
    noise = candidate_noise(policy, 9)
    actions = policy.act(histories, proximity, noise)
    assert actions.shape == (2, 9, len(log.card.action_features))
    assert actions.abs().max() <= 1.0
    policy.save(tmp_path)
    assert torch.equal(Policy.load(tmp_path).act(histories, proximity, noise), actions)


@in_every_world
@every_algorithm
def test_deployed_policy_sees_what_the_learner_saw(name: str, log: OfflineDataset) -> None:
    """Raw frames through the artifact equal scaled frames through the learner's own network."""
    made = learner(name, [log], [0])
    run(made, 4)
    takes_lambda = ALGORITHMS[name].TAKES_LAMBDA
    policy = made.policy(policy_card(log, takes_lambda=takes_lambda))
    index = torch.tensor([[0, 1, 7, 39, 40, 200]])
    observations = made._data.observations(index)
    histories = made._data.denormalise_history(observations)
    noise = candidate_noise(policy, 6)
    outside = policy.act(histories, torch.linspace(0, 1, 6)[None] if takes_lambda else None, noise)
    expected = inside(made, observations, noise).detach()
    torch.testing.assert_close(outside, expected, rtol=1e-4, atol=1e-5)  # scaled twice


@pytest.mark.parametrize("name", [n for n in ALGORITHMS if n not in WITHOUT_CRITICS])
def test_values_and_saturation_are_logged(name: str) -> None:
    made = learner(name, [LOG], [0])
    logged = {metric for metrics in run(made, 60) for metric in metrics}
    assert {"critic/value_magnitude", "actor/saturated_share"} <= logged


@every_algorithm
def test_a_policy_does_not_move_when_training_goes_on(name: str) -> None:
    made = learner(name, [LOG], [0])
    policy = made.policy(policy_card(LOG, takes_lambda=ALGORITHMS[name].TAKES_LAMBDA))
    before = [weight.clone() for weight, _ in policy.layers]
    run(made, 4)
    for old, (weight, _) in zip(before, policy.layers, strict=True):
        assert torch.equal(old, weight)


@in_every_world
@every_algorithm
def test_state_has_lanes_first_and_round_trips(name: str, log: OfflineDataset) -> None:
    made = learner(name, [log] * 3, range(3))
    run(made, 6)
    state = {k: v.clone() for k, v in made.state_dict().items()}
    assert {tensor.shape[0] % 3 for tensor in state.values()} == {0}
    expected = run(made, 4, start=6)
    other = learner(name, [log] * 3, range(3))
    other.load_state_dict(state)
    for ours, theirs in zip(run(other, 4, start=6), expected, strict=True):
        for metric, value in theirs.items():
            assert torch.equal(ours[metric], value)


@in_every_world
@pytest.mark.parametrize("name", graded(ALGORITHMS, 1))
def test_steps_of_a_branch_differ_in_what_is_drawn_alone(name: str, log: OfflineDataset) -> None:
    """So that one CUDA graph does for all of them."""
    one, other = (learner(name, [log], [0]) for _ in range(2))
    step = 20
    for made in (one, other):
        run(made, step)
    branch = one.branch(step)
    if branch is None:
        assert name == "morel"
        return
    later = next(n for n in range(step + 1, 100) if one.branch(n) == branch)
    other.stage(step)
    other._streams._staged = later
    expected = one.update(step)
    for metric, value in other.update(later).items():
        assert torch.equal(value, expected[metric])
    for key, tensor in other.state_dict().items():
        assert torch.equal(tensor, one.state_dict()[key])


def test_lanes_need_equal_shapes_and_one_machine() -> None:
    with pytest.raises(ValueError, match="equal frame, action and history widths"):
        LaneData([LOG, make_log(history=4)], CPU)
    other = make_log("other")
    other.card.machine["known"]["high"] = 90.0
    with pytest.raises(ValueError, match="same kind of machine"):
        _ = LearnerInputs(LaneData([LOG, relabelled(other)], CPU), [1, 2]).machine


def test_first_rows_stay_inside_their_episodes() -> None:
    short = make_log(episodes=2, steps=4)
    assert first_rows(short, 2).tolist() == [0, 1, 4, 5]
    assert first_rows(short, 9).tolist() == list(range(8))
    assert first_rows(short, 9, 3).tolist() == [3, 7]
    with pytest.raises(ValueError, match=r"No trajectory of toy has a step .* lower start_after"):
        first_rows(short, 9, 4)


@pytest.mark.parametrize("name", ["bcq", "bear"])
def test_candidates_are_judged_by_critics_without_hidden_layers_too(name: str) -> None:
    made = learner(name, [LOG], [0], hidden=())
    run(made, 2)
    policy = made.policy(policy_card(LOG))
    actions = policy.act(torch.full((1, 4, 3, 6), 50.0), None, candidate_noise(policy, 4))
    assert actions.shape == (1, 4, 3)
    assert actions.isfinite().all()
