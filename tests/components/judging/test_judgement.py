"""Judgements of policies on the small machine."""

from dataclasses import astuple, replace

import numpy as np
import pytest
import torch

from components.core.normaliser import Normaliser
from components.data.assembly import part_of
from components.judging.config import JudgeConfig
from components.judging.judged import JudgedPolicies
from components.judging.judgement import judge
from components.judging.rollouts import VirtualWorld
from components.judging.support import Support
from components.policies.policy import Policy
from tests.components.synthetic import (
    CPU,
    constant_policy,
    make_log,
    policy_card,
    random_ensemble,
    random_policy,
)

LOG = make_log(episodes=12)
CONFIG = JudgeConfig(
    proximity_step=0.5, starts=6, visited=50, neighbours=400, updates=20, hidden=(8,), batch=16
)


def steered_policy(snapshots: int = 2) -> Policy:
    """A policy of which proximity moves the first action, a snapshot the second."""
    width = len(LOG.card.frame_features) * LOG.card.history + 1
    weight = torch.zeros(snapshots, width, 3)
    weight[:, -1, 0] = 0.3
    bias = torch.zeros(snapshots, 1, 3)
    bias[:, 0, 1] = torch.linspace(-0.5, 0.5, snapshots)
    scaling = Normaliser(torch.zeros(snapshots, 6), torch.ones(snapshots, 6))
    card = policy_card(LOG, takes_proximity=True, steps=tuple(range(snapshots)))
    return Policy.of_networks(card, {"actor": [(weight, bias)]}, scaling)


def test_every_snapshot_acts_at_every_proximity() -> None:
    policy = steered_policy()
    judged = JudgedPolicies.of(policy, (0.0, 0.5, 1.0))
    seen = torch.randn(6, 4, 3, 6)
    found = judged.act(seen, key=1)
    for number in range(6):
        snapshot, proximity = divmod(number, 3)
        alone = policy.lane(snapshot, policy.card)
        expected = alone.act(seen[number][None], torch.full((1, 4), proximity / 2))
        assert torch.allclose(found[number], expected[0], atol=1e-6)  # sums in another order


def test_policies_that_take_no_proximity_have_none() -> None:
    judged = JudgedPolicies.of(random_policy(LOG, ("a", "b")), (0.0, 1.0))
    assert judged.count == 2
    assert np.isnan(judged.proximities).all()


def test_candidates_are_drawn_alike_for_all_policies() -> None:
    card = policy_card(LOG, kind="gaussian_candidates", candidates=5, noise=3, steps=(0, 1))
    weight, bias = torch.zeros(2, 18, 6), torch.zeros(2, 1, 6)
    critic = torch.zeros(2, 21, 1)
    critic[:, 18] = 1.0  # the greatest first action wins
    networks = {"actor": [(weight, bias)], "critic": [(critic, torch.zeros(2, 1, 1))]}
    scaling = Normaliser(torch.zeros(2, 6), torch.ones(2, 6))
    judged = JudgedPolicies.of(Policy.of_networks(card, networks, scaling), ())
    first, second = judged.act_at(torch.randn(7, 3, 6), key=3)
    assert torch.equal(first, second)
    assert first.std(dim=0)[0] > 0


def test_values_are_those_of_a_plain_loop_over_policies() -> None:
    ensemble, policies = random_ensemble(LOG, "e"), random_policy(LOG, ("a", "b", "c"))
    world = VirtualWorld(LOG, CONFIG, CPU)
    together = world.values(ensemble, JudgedPolicies.of(policies, ()))
    for number in range(3):
        alone = JudgedPolicies.of(policies.lane(number, policies.card), ())
        # Products of other sizes are rounded otherwise; returns are tens.
        assert torch.allclose(
            together.returns[number], world.values(ensemble, alone).returns[0], atol=1e-3
        )
    assert together.returns.shape == (3, ensemble.members, 6)
    assert together.visited.shape == (3, 50, 9)
    assert torch.equal(together.least, together.returns.mean(dim=2).amin(dim=1))


def test_the_logs_own_transitions_lie_within_its_support_and_foreign_ones_outside() -> None:
    own = np.concatenate([LOG.frames[LOG.frame_rows()], LOG.actions], axis=1)
    support = Support(LOG, own[-80:], 400, 0.99)
    # Those that are compared to are neighbours of themselves; of the held-out 80 one or two stray.
    assert support.outside(own) <= 0.01
    far = own.copy()
    far[:, 4] += 20 * own[:, 4].std()
    assert support.outside(np.stack([own, far])).tolist() == [support.outside(own), 1.0]


def test_what_the_behaviour_policy_visits_is_familiar() -> None:
    own = np.concatenate([LOG.frames[LOG.frame_rows()], LOG.actions], axis=1)
    away = own[:50] + 3 * own.std(axis=0)
    assert Support(LOG, own, 400, 0.99).outside(away) > 0.5
    assert Support(LOG, away, 400, 0.99).outside(away) <= 0.02  # beyond its quantile


def test_a_judgement_does_not_depend_on_the_other_policies() -> None:
    part = part_of(LOG, range(6, 12))
    ensemble, own = random_ensemble(part, "e"), random_ensemble(LOG, "own")
    behaviour = random_policy(part, ("behaviour",))
    stacks = [
        JudgedPolicies.of(random_policy(LOG, ("a", "b")), CONFIG.proximities),
        JudgedPolicies.of(steered_policy(), CONFIG.proximities),
    ]

    def judged(chosen: list[JudgedPolicies], trained_in: list) -> list:
        return judge(
            part,
            ensemble,
            behaviour,
            chosen,
            trained_in,
            CONFIG,
            CPU,
            names=list("xy")[: len(chosen)],
        )

    both = judged(stacks, [None, own])
    [alone] = judged(stacks[1:], [own])
    for together, apart in zip(astuple(both[1]), astuple(alone), strict=True):
        np.testing.assert_allclose(together, apart, rtol=2e-3, atol=2e-3)  # see above
    assert np.isnan(both[0].promised).all()
    assert np.isfinite(both[1].promised).all()
    assert both[0].model.shape == (2,)
    assert both[1].model.shape == (6,)


def test_where_policies_lead_lies_between_the_frames_on_the_way() -> None:
    world = VirtualWorld(LOG, CONFIG, CPU)
    found = world.values(random_ensemble(LOG, "e"), JudgedPolicies.of(steered_policy(), (0.0, 1.0)))
    low, high = found.frames.unbind(dim=1)
    assert low.shape == (4, len(LOG.card.frame_features))
    seen = found.visited[..., : low.shape[1]]
    inside = (seen >= low[:, None]) & (seen <= high[:, None])
    # Of 50 frames the first and the last of every feature lie beyond the 1st and 99th percentile.
    assert (inside.sum(dim=1) >= 48).all()
    assert (low >= seen.amin(dim=1)).all()
    assert (high <= seen.amax(dim=1)).all()
    assert not torch.equal(low[0], low[1]), "λ leads elsewhere"


def test_the_share_that_is_held_at_the_ensembles_ends_is_told() -> None:
    ensemble = random_ensemble(LOG, "e")
    narrow = replace(ensemble, low=ensemble.low * 0, high=ensemble.high * 0)
    judged = JudgedPolicies.of(steered_policy(1), (0.0,))
    wide, still = (VirtualWorld(LOG, CONFIG, CPU).values(one, judged) for one in (ensemble, narrow))
    learned = still.ends.isfinite()
    assert learned.any()
    assert not learned.all(), "what follows the actions is not held"
    # All but the frames in which trajectories start.
    assert (still.held[0][learned] >= 0.9).all()
    assert (still.held[0][~learned] == 0.0).all()
    assert (wide.held[0] < 0.9).all()


def test_without_an_ensemble_critics_and_the_support_remain() -> None:
    behaviour = random_policy(LOG, ("behaviour",))
    far = JudgedPolicies.of(constant_policy([0.99, -0.99, 0.99]), ())
    [found] = judge(LOG, None, behaviour, [far], [None], CONFIG, CPU, names="a")
    assert np.isnan(found.model).all()
    assert np.isnan(found.frames).all()
    assert np.isnan(found.held).all()
    assert np.isfinite(found.fitted_q).all()
    # Half of the log's actions are random, so most of these lie within; of its own, 1 % do not.
    assert found.outside > 0.05


def test_the_behaviour_policy_is_at_no_distance_from_itself() -> None:
    behaviour = random_policy(LOG, ("behaviour",))
    close = JudgedPolicies.of(behaviour, ())
    away = JudgedPolicies.of(constant_policy([0.9, 0.9, 0.9]), ())
    first, second = judge(
        LOG,
        random_ensemble(LOG, "e"),
        behaviour,
        [close, away],
        [None] * 2,
        CONFIG,
        CPU,
        names="ab",
    )
    assert first.distance == pytest.approx(0.0, abs=1e-6)
    assert second.distance > 0.1


def test_a_part_of_a_log_has_its_own_statistics_and_rows() -> None:
    part = part_of(LOG, range(2, 5))
    part.check("the part")
    assert part.episodes == 3
    assert part.card.name == LOG.card.name
    first = int(LOG.episode_starts[2])
    np.testing.assert_array_equal(part.actions, LOG.actions[first : first + part.transitions])
    np.testing.assert_array_equal(part.frames, LOG.frames[first + 2 :][: part.transitions + 3])
    assert part.card.first_window_return_mean != LOG.card.first_window_return_mean
    with pytest.raises(ValueError, match="has no episode"):
        part_of(LOG, range(3, 3))


@pytest.mark.parametrize(
    "wrong",
    [
        {"proximity_step": 0.3},
        {"starts": 0},
        {"quantile": 1.0},
        {"hidden": ()},
        {"target_rate": 0.0},
        {"replicas": 0},
    ],
)
def test_settings_outside_their_range_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(CONFIG, **wrong)
