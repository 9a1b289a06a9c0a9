"""Unknown states and HALT by hand and by plain loops."""

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms.parts import pessimistic_mdp
from components.algorithms.parts.advantages import discounted_returns, generalised_advantages
from components.algorithms.parts.halting import Trajectories, live_samples, with_halt
from components.algorithms.parts.pessimistic_mdp import Detector, disagreement
from components.data.batches import LaneData
from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification
from components.models.mlp_ensemble.ensemble import MLPTransition
from components.models.transition.interface import Prediction
from components.models.transition.model_environment import ModelEnvironment
from tests.components.models.plain import member_outputs
from tests.components.synthetic import CPU, SCALE, make_log, random_mlp_ensemble

LOG, OTHER = make_log(), make_log("other", seed=5, episodes=4, explore=0.2)
NEVER, ALWAYS = 1e9, -1e9


def detector(logs: list[OfflineDataset], beta: float) -> Detector:
    data = LaneData(logs, CPU)
    model = MLPTransition(
        [random_mlp_ensemble(log, log.card.name, members=4) for log in logs],
        data.frame_scaling,
        CPU,
    )
    rule = DynamicsSpecification.of_card(logs[0].card)
    return Detector(ModelEnvironment(model, rule, data.frame_scaling, CPU), data, beta)


def doubt(log: OfflineDataset, row: int) -> float:
    """Disagreement about a logged transition, pair by pair in double precision."""
    ensemble = random_mlp_ensemble(log, log.card.name, members=4)
    episode, step = divmod(row, log.card.steps)
    first = episode * (log.card.steps + 1)
    history = np.stack([log.frames[first + max(step - lag, 0)] for lag in range(3)])
    moved = np.clip(history[0, 1:4] + SCALE * log.actions[row], 0.0, 100.0)
    inputs = np.concatenate([history[0, :1], moved])
    unit = ensemble.target_scale.double().numpy()
    said = [member_outputs(ensemble, k, history, inputs)[0] / unit for k in range(4)]
    return max(float(np.linalg.norm(a - b)) for a, b in itertools.combinations(said, 2))


def test_disagreement_by_hand() -> None:
    # two targets, three members, two trajectories; standardised by 2 and 0.5
    values = torch.tensor(
        [[[[0.0, 1.0], [6.0, 1.0], [0.0, 5.0]], [[0.0, 1.0], [2.0, 1.0], [0.5, 2.5]]]]
    )
    found = disagreement(Prediction(values), torch.tensor([[2.0, 0.5]]))
    # (0,0), (3,4), (0,1): the first two are 5 apart; (.5,2), (.5,2), (2.5,5): 13 ** 0.5
    torch.testing.assert_close(found, torch.tensor([[5.0, math.sqrt(13.0)]]))


@pytest.mark.parametrize("chunk", [4096, 60])
def test_threshold_is_the_mean_plus_beta_deviations_of_the_log(
    chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pessimistic_mdp, "CHUNK", chunk)  # 30 transitions of either lane at a time
    made = detector([LOG, OTHER], 1.5)  # 240 and 160 transitions
    for lane, log in enumerate((LOG, OTHER)):
        doubts = [doubt(log, row) for row in range(log.transitions)]
        mean = sum(doubts) / len(doubts)
        deviation = math.sqrt(sum((d - mean) ** 2 for d in doubts) / len(doubts))
        assert deviation > 0.1 * mean
        # float32 predictions
        assert made.threshold[lane].item() == pytest.approx(mean + 1.5 * deviation, rel=1e-4)
        known = np.mean(np.array(doubts) <= mean + 1.5 * deviation)
        assert 0.8 < known < 1.0
        assert made.known_share[lane].item() == pytest.approx(known, abs=1e-6)  # float32


def test_a_single_member_is_refused() -> None:
    data = LaneData([LOG], CPU)
    model = MLPTransition([random_mlp_ensemble(LOG, "x", members=1)], data.frame_scaling, CPU)
    machine = ModelEnvironment(
        model, DynamicsSpecification.of_card(LOG.card), data.frame_scaling, CPU
    )
    with pytest.raises(ValueError, match="needs members=2"):
        Detector(machine, data, 1.0)


def toy() -> tuple[Tensor, Tensor]:
    """Rewards and doubts of three steps: halting at once, at the last step, never, in between."""
    rewards = torch.tensor([[1.0, 1.0, 1.0, 1.0], [2.0, 2.0, 2.0, 2.0], [4.0, 4.0, 4.0, 4.0]])
    doubts = torch.tensor([[9.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.5, 1.5], [9.0, 1.1, 1.0, 0.0]])
    return rewards[:, None], doubts[:, None]


def test_halt_by_hand() -> None:
    rewards, doubts = toy()
    # HALT pays -3 a step: -3 / (1 - 0.5) = -6 for ever
    ended = with_halt(rewards, doubts, torch.tensor([1.0]), torch.tensor([-3.0]), 0.5)
    assert ended.halts[:, 0].tolist() == [
        [True, False, False, False],
        [False, False, False, True],
        [False, True, False, False],
    ]
    assert ended.alive[:, 0].tolist() == [
        [True] * 4,
        [False, True, True, True],
        [False, True, True, False],
    ]
    assert ended.continues[:, 0].tolist() == [[0, 1, 1, 1], [1, 1, 1, 0], [1, 0, 1, 1]]
    returns = discounted_returns(ended.rewards, ended.continues, 0.5)[:, 0]
    # at once; 1 + 2/2 - 6/4; 1 + 2/2 + 4/4; 1 - 6/2
    assert returns[0].tolist() == [-6.0, 0.5, 3.0, -2.0]
    assert returns[1, 1:].tolist() == [2.0 - 3.0, 2.0 + 2.0, -6.0]
    assert returns[2, 1:3].tolist() == [-6.0, 4.0]


def test_advantages_do_not_look_behind_halt() -> None:
    rewards, doubts = toy()
    ended = with_halt(rewards, doubts, torch.tensor([1.0]), torch.tensor([-3.0]), 0.5)
    values = torch.tensor([10.0, 20.0, 30.0, 40.0])[:, None, None].expand(-1, 1, 4)
    found = generalised_advantages(ended.rewards, values, ended.continues, 0.5, 0.5)[:, 0]
    # surprises: 1 + 20/2 - 10 = 1; 2 + 30/2 - 20 = -3; 4 + 40/2 - 30 = -6; HALT: -6 - V(s_t)
    assert found[0].tolist() == [-6.0 - 10.0, 1 - 3 / 4 - 36 / 16, 1 - 3 / 4 - 6 / 16, 1 - 26 / 4]
    assert found[1, 1:].tolist() == [-3 - 36 / 4, -3 - 6 / 4, -26.0]
    assert found[2, 1:3].tolist() == [-6.0 - 30.0, -6.0]


def test_what_is_undefined_is_unknown() -> None:
    rewards, doubts = toy()
    doubts[1, 0, 2] = torch.nan
    ended = with_halt(rewards, doubts, torch.tensor([1.0]), torch.tensor([-3.0]), 0.5)
    assert ended.halts[:, 0, 2].tolist() == [False, True, False]


@pytest.mark.parametrize(("threshold", "halted", "alive"), [(NEVER, 0, 12), (ALWAYS, 4, 4)])
def test_thresholds_without_end(threshold: float, halted: int, alive: int) -> None:
    ended = with_halt(*toy(), torch.tensor([threshold]), torch.tensor([-3.0]), 0.5)
    assert ended.halts.sum() == halted
    assert ended.alive.sum() == alive
    if halted:
        assert (ended.rewards[0] == -6.0).all()
    else:
        assert torch.equal(ended.rewards, toy()[0])


def test_lanes_have_their_own_threshold_and_halt() -> None:
    rewards, doubts = (x.expand(-1, 2, -1) for x in toy())
    ended = with_halt(rewards, doubts, torch.tensor([1.0, ALWAYS]), torch.tensor([-3.0, -5.0]), 0.5)
    assert ended.rewards[0].tolist() == [[-6.0, 1.0, 1.0, 1.0], [-10.0] * 4]


def test_live_samples_are_permuted_and_repeated() -> None:
    alive = torch.tensor(
        [[1, 0, 1, 1, 0, 0, 0], [1, 1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 1, 0, 0]]
    ).bool()
    order = torch.tensor([[6, 3, 5, 0, 1, 2, 4]] * 3)
    found = live_samples(alive, order)
    assert found.tolist() == [[3, 0, 2, 3, 0, 2, 3], [6, 3, 5, 0, 1, 2, 4], [4] * 7]


def test_observations_are_put_together_from_frames() -> None:
    generator = torch.Generator().manual_seed(0)
    begin = torch.randn(2, 5, 3 * 4, generator=generator)  # histories of three frames
    frames = [torch.randn(2, 5, 4, generator=generator) for _ in range(6)]
    made = Trajectories(begin, frames)
    seen, expected = begin, []
    for frame in frames:
        expected.append(seen)
        seen = torch.cat([frame, seen[..., :-4]], dim=-1)
    expected.append(seen)
    index = torch.randperm(35, generator=generator).expand(2, -1)
    found = made.observations(index)
    for lane, n in np.ndindex(2, 35):
        step, b = divmod(int(index[lane, n]), 5)
        assert torch.equal(found[lane, n], expected[step][lane, b])
