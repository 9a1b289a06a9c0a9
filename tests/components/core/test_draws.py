"""Numbers of drawing rules have the distributions that they promise, and are independent.

Words are fixed, so every test gives the same answer each time. Their limits are those of 5 standard
errors, or a level of 1e-4: a wrong rule is off by hundreds of these.
"""

import numpy as np
import pytest
import torch
from scipy import stats

from components.core.draws import (
    Beta,
    Choice,
    Draw,
    Integers,
    Normal,
    Order,
    Uniform,
    UniformDouble,
)
from components.core.philox import host_words

N = 200_000
LEVEL = 1e-4


def drawn(rule: Draw, steps: int = 1, key: int = 1) -> torch.Tensor:
    """Numbers of one lane and several steps."""
    words = host_words(key, 0, -(-rule.words * steps // 4)).flatten()[: rule.words * steps]
    made: torch.Tensor = rule(words.view(steps, 1, rule.words))
    return made


def independent(numbers: torch.Tensor) -> None:
    """Neighbours, and the two halves of which pairs are made, are not correlated."""
    flat = numbers.flatten().double()
    for lag in (1, 2, len(flat) // 2):
        r = float(torch.corrcoef(torch.stack([flat[lag:], flat[:-lag]]))[0, 1])
        assert abs(r) < 5 / (len(flat) - lag) ** 0.5, lag


def test_normal_numbers() -> None:
    numbers = drawn(Normal(N))
    assert numbers.dtype == torch.float32
    assert stats.kstest(numbers.flatten().numpy(), "norm").pvalue > LEVEL
    independent(numbers)
    independent(numbers.square())  # pairs share their radius: only squares would tell
    assert float(numbers.abs().max()) < 5.78


def test_extreme_words_give_finite_normal_numbers() -> None:
    words = torch.tensor([0, -1, 2**63 - 1, -(2**63)]).view(1, 1, 4)
    numbers = Normal(8)(words)
    assert numbers.isfinite().all()
    # The least fraction is 2**-24, and sqrt(48 log 2) is 5.77.
    assert float(numbers.abs().max()) == pytest.approx((48 * np.log(2)) ** 0.5, rel=1e-6)


@pytest.mark.parametrize("rule", [Uniform(N, low=-1.0), UniformDouble(N)])
def test_uniform_numbers(rule: Draw) -> None:
    numbers = drawn(rule).flatten()
    low = -1.0 if isinstance(rule, Uniform) else 0.0
    assert low <= float(numbers.min())
    assert float(numbers.max()) < 1.0
    assert stats.kstest(numbers.numpy(), "uniform", (low, 1.0 - low)).pvalue > LEVEL
    independent(numbers)


@pytest.mark.parametrize("limit", [1, 7, 1000, (1 << 31) - 1])
def test_integers_are_equally_likely(limit: int) -> None:
    numbers = drawn(Integers([limit], N)).flatten()
    assert numbers.dtype == torch.int64
    assert int(numbers.min()) >= 0
    assert int(numbers.max()) < limit
    classes = min(limit, 1000)
    counts = np.bincount((numbers * classes // limit).numpy(), minlength=classes)
    assert classes == 1 or stats.chisquare(counts).pvalue > LEVEL


def test_limits_outside_their_range_are_refused() -> None:
    for limit in (0, -1, 1 << 31):
        with pytest.raises(ValueError, match=r"must lie in \[1, 2\*\*31\)"):
            Integers([5, limit], 3)


def test_every_lane_has_limits_and_lists_of_its_own() -> None:
    words = host_words(3, 0, 1000).view(1, 2, -1)
    integers = Integers([2, 1000], 50, 4)(words)
    assert integers.shape == (1, 2, 50, 4)
    assert integers[0].flatten(1).amax(dim=1).tolist() == [1, int(integers[0, 1].max())]
    assert int(integers[0, 1].max()) > 900
    own = [np.array([5, 6]), np.array([1, 2, 3])]
    chosen = Choice(own, 50, 4)(words)
    assert chosen.shape == (1, 2, 50, 4)
    assert [chosen[0, lane].unique().tolist() for lane in (0, 1)] == [[5, 6], [1, 2, 3]]


def test_orders_are_permutations_and_equally_likely() -> None:
    orders = drawn(Order(4), steps=24_000)[:, 0]
    assert torch.equal(orders.sort(dim=-1).values, torch.arange(4).expand(24_000, 4))
    _, counts = np.unique(orders.numpy(), axis=0, return_counts=True)
    assert len(counts) == 24
    assert stats.chisquare(counts).pvalue > LEVEL


@pytest.mark.parametrize("parameter", [0.05, 0.5, 0.6, 1.0, 3.0, 500.0])
def test_beta_numbers_are_the_quantiles_of_uniform_ones(parameter: float) -> None:
    numbers = drawn(Beta(parameter, N)).flatten()
    assert numbers.dtype == torch.float32
    shares = drawn(UniformDouble(N)).flatten().numpy()  # of the same words
    exact = torch.from_numpy(stats.beta(parameter, parameter).ppf(shares)).float()
    # Interpolated over 5e-5 of angle; single precision has 6e-8 near 1.
    torch.testing.assert_close(numbers, exact, rtol=0.0, atol=1e-6)
    if parameter >= 0.5:  # others have most of their mass where single precision has only 0 and 1
        independent(numbers)
