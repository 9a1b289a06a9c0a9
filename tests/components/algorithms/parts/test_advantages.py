"""Advantages, returns and baselines against plain loops."""

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms.parts.advantages import (
    Baseline,
    discounted_returns,
    generalised_advantages,
    whitened,
)
from tests.components.algorithms.plain import floats, network
from tests.components.synthetic import keys

STEPS, LANES, BATCH = 6, 2, 3


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).double()


def some_ends() -> Tensor:
    """1 everywhere but where three of the trajectories end: at the first, a middle, the last."""
    continues = torch.ones(STEPS, LANES, BATCH).double()
    continues[0, 0, 0] = continues[3, 0, 1] = continues[-1, 1, 2] = 0.0
    return continues


@pytest.mark.parametrize("trace", [0.0, 0.7, 1.0])
def test_advantages_by_a_plain_loop(trace: float) -> None:
    rewards, values, continues = (
        drawn(STEPS, LANES, BATCH),
        drawn(STEPS + 1, LANES, BATCH, seed=1),
        some_ends(),
    )
    found = generalised_advantages(rewards, values, continues, 0.9, trace)
    for t, lane, b in np.ndindex(STEPS, LANES, BATCH):
        expected, weight = 0.0, 1.0
        for k in range(t, STEPS):
            here, ahead = float(values[k, lane, b]), float(values[k + 1, lane, b])
            ends = continues[k, lane, b] == 0.0
            expected += weight * (
                float(rewards[k, lane, b]) + (0.0 if ends else 0.9 * ahead) - here
            )
            weight *= 0.9 * trace
            if ends:
                break
        assert found[t, lane, b].item() == pytest.approx(expected, rel=1e-12, abs=1e-12)  # double


def test_the_horizon_is_a_time_out_unless_the_last_step_is_terminal() -> None:
    rewards, values = torch.zeros(2, 1, 2), torch.tensor([[[0.0, 0.0]], [[0.0, 0.0]], [[7.0, 7.0]]])
    continues = torch.tensor([[[1.0, 1.0]], [[1.0, 0.0]]])
    found = generalised_advantages(rewards, values, continues, 0.5, 1.0)
    assert found[:, 0].tolist() == [[0.25 * 7.0, 0.0], [0.5 * 7.0, 0.0]]


def test_returns_by_a_plain_loop() -> None:
    rewards, continues = drawn(STEPS, LANES, BATCH), some_ends()
    found = discounted_returns(rewards, continues, 0.9)
    for t, lane, b in np.ndindex(STEPS, LANES, BATCH):
        expected = 0.0
        for k in range(t, STEPS):
            expected += 0.9 ** (k - t) * float(rewards[k, lane, b])
            if continues[k, lane, b] == 0.0:
                break
        assert found[t, lane, b].item() == pytest.approx(expected, rel=1e-12, abs=1e-12)  # double


def test_whitening_counts_only_what_counts() -> None:
    estimates = drawn(2, 8)
    counts = torch.ones(2, 8, dtype=torch.bool)
    counts[0, [1, 5, 6]] = False
    estimates[0, 5] = 1e6
    found = whitened(estimates, counts)
    for lane in range(2):
        chosen = estimates[lane][counts[lane]].numpy()
        expected = (chosen - chosen.mean()) / (chosen.std() + 1e-6)
        np.testing.assert_allclose(
            found[lane][counts[lane]], expected, rtol=1e-6
        )  # weights float32
    assert found[0, [1, 5, 6]].tolist() == [0.0, 0.0, 0.0]


def test_a_single_sample_has_no_advantage() -> None:
    counts = torch.zeros(1, 4, dtype=torch.bool)
    counts[0, 2] = True
    assert whitened(drawn(1, 4), counts).tolist() == [[0.0] * 4]


def test_baseline_reads_the_state_and_powers_of_the_time() -> None:
    scale = torch.tensor([50.0, 2.0])
    made = Baseline(keys("a", "b"), 3, (5,), 10, scale)
    seen, time = drawn(2, 4, 3).float(), torch.tensor([[0, 3, 7, 10], [10, 5, 5, 1]])
    returns = 10.0 * drawn(2, 4, seed=1).float()
    values, losses = made(seen, time), made.loss(seen, time, returns)
    for lane in range(2):
        share = time[lane].double().numpy()[:, None] / 10.0
        inputs = np.concatenate([floats(seen)[lane], share, share**2, share**3, share**4], axis=1)
        expected = network(made.stack, lane, inputs)[:, 0]
        # two layers in float32
        np.testing.assert_allclose(floats(values)[lane], expected * float(scale[lane]), rtol=1e-4)
        error = expected - floats(returns)[lane] / float(scale[lane])
        assert losses[lane].item() == pytest.approx(np.mean(error**2), rel=1e-4)
