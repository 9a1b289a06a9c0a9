"""The price on leaving the log's support: closed form, gradients, what it prevents."""

from typing import Any

import numpy as np
import pytest
import torch

from components.algorithms.lion import Config
from components.algorithms.parts.caution import Caution
from components.algorithms.wsbc import Config as SwarmConfig
from components.core.options import identity
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.models.transition.interface import Prediction
from components.models.transition.model_environment import RolloutStep
from tests.components.algorithms.stacks import learner, run
from tests.components.synthetic import CPU, make_log, policy_card

LOG = make_log()
OTHER = make_log("other", seed=5)
SHORT = make_log("short", seed=6, episodes=3, steps=20)
"""A sixth as many pairs as the others have."""
STILL = make_log("still", explore=0.0)
"""The log of a controller that does not explore: any other action is foreign."""
HISTORY = 3


def step_of(pairs: torch.Tensor, values: torch.Tensor | None = None) -> RolloutStep:
    """A step whose newest frames and actions are ``pairs [L, N, F + A]``."""
    frames, actions = pairs[..., :6], pairs[..., 6:]
    older = torch.full_like(frames, 99.0).repeat(1, 1, HISTORY - 1)
    nothing = torch.zeros(*pairs.shape[:2])
    prediction = Prediction(
        torch.zeros(len(pairs), 2, 4, pairs.shape[1]) if values is None else values
    )
    seen = torch.cat([frames, older], dim=-1)
    return RolloutStep(seen, actions, nothing, frames, prediction, nothing)


def logged_pairs(data: LaneData, lane: int) -> np.ndarray:
    """Scaled frames with actions of all logged transitions, ``[N, F + A]``."""
    log = data.datasets[lane]
    scaling = data.frame_scaling
    frames = (log.frames[log.frame_rows()] - scaling.mean[lane].numpy()) / scaling.scale[
        lane
    ].numpy()
    return np.concatenate([frames, log.actions], axis=1)


def test_the_excess_by_plain_loops() -> None:
    data = LaneData([LOG, OTHER], CPU)
    caution = Caution(data, data.frame_scaling)
    generator = torch.Generator().manual_seed(0)
    steps = [step_of(3 * torch.randn(2, 5, 9, generator=generator)) for _ in range(12)]
    found = caution.excess(steps, 0.97)
    for lane in range(2):
        pairs = logged_pairs(data, lane)
        # The last of six episodes of 40 steps is held out.
        near, own = pairs[:200], pairs[200:]
        unit = near.std(axis=0, ddof=1)
        unit[unit == 0] = 1.0

        def distance(pair: np.ndarray) -> float:
            return float(np.sqrt(np.square((pair - near) / unit).sum(axis=1)).min())  # noqa: B023

        limit = np.quantile([distance(pair) for pair in own], 0.99)
        # float32 distances near 1 as differences of squares choose the neighbour alone
        assert float(caution.limit[lane]) == pytest.approx(limit, rel=1e-4)
        for n in range(5):
            total = weights = 0.0
            for t in (0, 5, 10):
                step = steps[t]
                pair = torch.cat([step.observations[lane, n, :6], step.actions[lane, n]]).numpy()
                total += 0.97**t * max(0.0, 1 - limit / distance(pair))
                weights += 0.97**t
            assert float(found[lane, n]) == pytest.approx(total / weights, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("measure", ["distance", "disagreement"])
def test_a_lane_does_not_feel_how_long_the_other_logs_are(measure: str) -> None:
    generator = torch.Generator().manual_seed(0)
    pairs = 3 * torch.randn(2, 5, 9, generator=generator)
    values = torch.randn(2, 2, 4, 5, generator=generator)
    logs = [LOG, SHORT]

    def limit_and_excess(lanes: slice) -> tuple[torch.Tensor, torch.Tensor]:
        data = LaneData(logs[lanes], CPU)
        caution = Caution(data, data.frame_scaling, measure)
        caution.familiar([step_of(pairs[lanes] / 9, values[lanes] / 2)])
        return caution.limit, caution.excess([step_of(pairs[lanes], values[lanes])], 0.9)

    both = limit_and_excess(slice(0, 2))
    assert (both[1] > 0).any(dim=1).all()
    for lane in range(2):
        for stacked, alone in zip(both, limit_and_excess(slice(lane, lane + 1)), strict=True):
            # float32 sums of other shapes
            torch.testing.assert_close(stacked[lane], alone[0], rtol=1e-6, atol=0.0)


def test_what_the_behaviour_policy_visits_is_familiar() -> None:
    data = LaneData([LOG], CPU)
    caution = Caution(data, data.frame_scaling)
    far = [step_of(torch.full((1, 4, 9), 5.0))]
    assert (caution.excess(far, 0.9) > 0.5).all()
    caution.familiar(far)
    assert (caution.excess(far, 0.9) == 0.0).all()


def test_disagreement_is_that_of_the_members() -> None:
    data = LaneData([LOG], CPU)
    caution = Caution(data, data.frame_scaling, "disagreement")
    values = torch.tensor([0.0, 1.0, 2.0, 3.0]).view(1, 1, 4, 1) * torch.ones(1, 2, 4, 3)
    pairs = torch.zeros(1, 3, 9)
    caution.familiar([step_of(pairs, values / 4)])
    # Four times the limit: three quarters lie beyond it.
    assert caution.excess([step_of(pairs, values)], 0.9).tolist() == [[0.75] * 3]


def test_gradients_lead_back_into_the_log() -> None:
    data = LaneData([LOG], CPU)
    caution = Caution(data, data.frame_scaling)
    # On a logged pair the distance is 0, and the gradient defined; far away it still points home.
    for pairs in (
        torch.from_numpy(logged_pairs(data, 0)[None, :3]).float(),
        torch.full((1, 3, 9), 50.0),
    ):
        pairs.requires_grad_()
        before = caution.excess([step_of(pairs)], 0.9)
        [gradient] = torch.autograd.grad(before.sum(), pairs)
        assert gradient.isfinite().all()
    assert (gradient.abs().sum(dim=2) > 0).all()
    assert (caution.excess([step_of(pairs - 1e4 * gradient)], 0.9) < before).all()


@pytest.mark.parametrize(
    ("config", "algorithm"), [(Config, "lion"), (SwarmConfig, "wsbc")], ids=["lion", "wsbc"]
)
def test_without_caution_nothing_changes(config: Any, algorithm: str) -> None:
    assert not {"caution", "caution_by"} & set(identity(config()))
    assert identity(config(caution=0.5))["caution"] == 0.5
    plain, free = learner(algorithm, [LOG], [0]), learner(algorithm, [LOG], [0], caution=0.0)
    run(plain, 3)
    run(free, 3)
    for name, tensor in plain.state_dict().items():
        assert torch.equal(free.state_dict()[name], tensor)
    for wrong, says in (({"caution": -1.0}, "not be negative"), ({"caution_by": "x"}, "one of")):
        with pytest.raises(ValueError, match=says):
            config(**wrong)


@pytest.mark.parametrize("beside", [LOG, SHORT], ids=["equal", "short"])
@pytest.mark.parametrize("algorithm", ["lion", "wsbc"])
def test_stacked_is_alone(algorithm: str, beside: OfflineDataset) -> None:
    stacked = learner(algorithm, [beside, STILL], [0, 0], caution=0.5)
    alone = learner(algorithm, [STILL], [0], caution=0.5)
    run(stacked, 3)
    run(alone, 3)
    card = policy_card(takes_proximity=algorithm == "lion")
    both, one = stacked.policy(card), alone.policy(card)
    for (ours, _), (theirs, _) in zip(both.layers, one.layers, strict=True):
        # float32 products of other shapes
        torch.testing.assert_close(ours[1:], theirs, rtol=1e-4, atol=1e-5)


def trained(algorithm: str, caution: float | None, **sizes: Any) -> Any:
    made = learner(algorithm, [STILL], [0], caution=caution, **sizes)
    run(made, sizes["updates"])
    return made


@pytest.mark.slow(15)
@pytest.mark.parametrize(
    ("algorithm", "sizes"),
    [
        ("lion", {"updates": 40, "learning_rate": 3e-2, "return_scale": 2.0}),
        ("wsbc", {"updates": 25, "particles": 21, "box": 0.5}),
    ],
)
def test_caution_keeps_a_policy_where_the_model_was_fitted(
    algorithm: str, sizes: dict[str, Any]
) -> None:
    """A model of random weights promises much far from the log: who is cautious stays near it."""
    proximity = torch.ones(1, 60) if algorithm == "lion" else None
    data = LaneData([STILL], CPU)
    support = Caution(data, data.frame_scaling)
    outside = []
    for caution in (None, 20.0):
        made = trained(algorithm, caution, **sizes)
        seen = data.observations(torch.arange(60)[None])
        with torch.no_grad():
            pairs = torch.cat([seen[..., :6], made.act(seen, proximity)], dim=-1)
        outside.append(float(support.excess([step_of(pairs)], 0.9).mean()))
    bold, careful = outside
    # measured: LION 0.25 and 0.12, WSBC 0.14 and 0.06
    assert bold > 0.1
    assert careful < 0.6 * bold
