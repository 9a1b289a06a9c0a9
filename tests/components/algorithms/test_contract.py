"""What every algorithm owes: shapes, bounds, finite metrics, policies that can be stored.

In two worlds: a machine that shows padded histories and never ends, and a robot that falls.
"""

import dataclasses
from pathlib import Path

import pytest
import torch

from components.algorithms import ALGORITHMS
from components.algorithms.parts.learner import LearnerInputs
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.sizes import DataSizes
from components.data.starts import start_rows
from components.models import MODELS
from components.policies.policy import Policy
from components.training.cuda_graphs import GraphedLearner, lost_graphs
from components.training.loop import TrainingLoop
from components.training.recorded import RecordedGraphs
from tests.components.algorithms.stacks import graded, learner, run
from tests.components.robot import make_robot_log
from tests.components.synthetic import CPU, make_log, policy_card, relabelled

LOG = make_log()
every_algorithm = pytest.mark.parametrize("name", ALGORITHMS)
in_every_world = pytest.mark.parametrize("log", [LOG, make_robot_log()], ids=lambda d: d.card.name)


def candidate_noise(policy: Policy, batch: int) -> torch.Tensor | None:
    """What a policy that draws candidates is given."""
    if not policy.card.candidates:
        return None
    shape = (policy.lanes, batch, policy.card.candidates, policy.card.noise)
    return torch.randn(shape, generator=torch.Generator().manual_seed(1))


@every_algorithm
def test_records_tell_what_plans_need(name: str) -> None:
    record = ALGORITHMS[name]
    assert record.name == name
    assert set(record.needs) <= set(MODELS)
    assert record.version >= 1
    assert record.frame_epsilon >= 0.0
    settings = record.config()
    assert settings.updates >= 1
    more = dataclasses.replace(settings, updates=2 * settings.updates)
    usual, wide = DataSizes(), DataSizes(history=60)
    assert 0.0 < record.cost(settings, usual) < record.cost(more, usual)
    if hasattr(settings, "hidden"):  # the swarm moves the weights of another model
        assert record.cost(settings, usual) < record.cost(settings, wide)


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
    takes_proximity = ALGORITHMS[name].takes_proximity
    has_rate = hasattr(ALGORITHMS[name].config, "learning_rate")
    made = learner(name, [log] * 2, range(2), **({"learning_rate": 0.03} if has_rate else {}))
    run(made, 20)
    policy = made.policy(policy_card(log, takes_proximity=takes_proximity))
    assert policy.lanes == 2
    shape = (2, 9, log.card.history, len(log.card.frame_features))
    histories = 50.0 * torch.randn(shape, generator=torch.Generator().manual_seed(0))
    proximity = torch.linspace(0, 1, 9).expand(2, -1) if takes_proximity else None
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
    takes_proximity = ALGORITHMS[name].takes_proximity
    policy = made.policy(policy_card(log, takes_proximity=takes_proximity))
    index = torch.tensor([[0, 1, 7, 39, 40, 200]])
    observations = made._data.observations(index)
    histories = made._data.raw_histories(index)
    noise = candidate_noise(policy, 6)
    proximity = torch.linspace(0, 1, 6)[None] if takes_proximity else None
    outside = policy.act(histories, proximity, noise)
    expected = made.act(observations, proximity, noise).detach()
    torch.testing.assert_close(outside, expected, rtol=1e-4, atol=1e-5)  # scaled twice


@every_algorithm
def test_acting_needs_what_the_policy_takes(name: str) -> None:
    made = learner(name, [LOG], [0])
    observations = made._data.observations(torch.tensor([[0, 1]]))
    policy = made.policy(policy_card(LOG, takes_proximity=ALGORITHMS[name].takes_proximity))
    if ALGORITHMS[name].takes_proximity:
        with pytest.raises(ValueError, match="need proximity"):
            made.act(observations)
    elif policy.card.candidates:
        with pytest.raises(ValueError, match="need noise"):
            made.act(observations)
    else:
        assert made.act(observations).shape == (1, 2, 3)


@every_algorithm
def test_values_and_saturation_of_actor_critics_are_logged(name: str) -> None:
    made = learner(name, [LOG], [0])
    if not any(network.startswith("critic") for network in made._networks):
        pytest.skip("has no critics")
    logged = {metric for metrics in run(made, 60) for metric in metrics}
    assert {"critic/value_magnitude", "actor/saturated_share"} <= logged


@every_algorithm
def test_a_policy_does_not_move_when_training_goes_on(name: str) -> None:
    made = learner(name, [LOG], [0])
    policy = made.policy(policy_card(LOG, takes_proximity=ALGORITHMS[name].takes_proximity))
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
@pytest.mark.parametrize("name", graded(ALGORITHMS, 4))
def test_updates_follow_as_graphs_of_several(name: str, log: OfflineDataset) -> None:
    """Steps of a branch differ in what is staged alone, and no update waits for the host."""
    plain, made = (learner(name, [log] * 2, range(2)) for _ in range(2))
    several = min(made.updates_per_graph, 4)
    made.updates_per_graph = several
    graphs = GraphedLearner(made, RecordedGraphs())
    loop = TrainingLoop(34, "ab", log_every=8)
    with lost_graphs() as lost:
        expected, found = loop.run(plain), loop.run(graphs, at=())
    assert lost == []
    assert graphs.captured >= 1
    for ours, theirs in zip(
        (found.tensors(), graphs.state_dict()),
        (expected.tensors(), plain.state_dict()),
        strict=True,
    ):
        assert ours.keys() == theirs.keys()
        for key, tensor in theirs.items():
            assert torch.equal(ours[key], tensor), key


def test_lanes_need_equal_shapes_and_dynamics() -> None:
    with pytest.raises(ValueError, match="equal frame, action and history widths"):
        LaneData([LOG, make_log(history=4)], CPU)
    other = make_log("other")
    other.card.dynamics["known"]["high"] = 90.0
    with pytest.raises(ValueError, match="different dynamics; train them apart"):
        _ = LearnerInputs(LaneData([LOG, relabelled(other)], CPU), [1, 2]).dynamics


def test_start_rows_stay_inside_their_episodes() -> None:
    short = make_log(episodes=2, steps=4)
    assert start_rows(short, 2).tolist() == [0, 1, 4, 5]
    assert start_rows(short, 9).tolist() == list(range(8))
    assert start_rows(short, 9, 3).tolist() == [3, 7]
    with pytest.raises(ValueError, match=r"No trajectory of toy has a step .* lower start_after"):
        start_rows(short, 9, 4)


@pytest.mark.parametrize("name", ["bcq", "bear"])
def test_candidates_are_judged_by_critics_without_hidden_layers_too(name: str) -> None:
    made = learner(name, [LOG], [0], hidden=())
    run(made, 2)
    policy = made.policy(policy_card(LOG))
    actions = policy.act(torch.full((1, 4, 3, 6), 50.0), None, candidate_noise(policy, 4))
    assert actions.shape == (1, 4, 3)
    assert actions.isfinite().all()
