"""The swarm by hand and by plain loops, and on functions whose minima are known."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from components.algorithms.parts.particle_swarm import Swarm, SwarmRule

USUAL = SwarmRule(neighbourhood=3, inertia=0.7298, own_pull=1.49618, ring_pull=1.49618)


def swarm(rule: SwarmRule, positions: list, low: float, high: float) -> Swarm:
    """Swarms in boxes of equal sides, in double precision."""
    placed = torch.tensor(positions, dtype=torch.float64)
    corner = torch.ones_like(placed[:, 0])
    return Swarm(rule, placed, low * corner, high * corner)


def test_two_moves_of_a_tiny_swarm_by_hand() -> None:
    rule = SwarmRule(neighbourhood=3, inertia=0.5, own_pull=2.0, ring_pull=1.0)
    made = swarm(rule, [[[0.0], [4.0], [1.0], [-3.0], [2.0]]], -10.0, 10.0)
    made.remember(torch.tensor([[1.0, 2.0, 5.0, 0.0, 3.0]], dtype=torch.float64))
    half, ones = torch.full((1, 5, 1), 0.5), torch.ones(1, 5, 1)
    made.move(half, half)
    # Nobody is away from its own best. Neighbours on the ring 0-1-2-3-4-0: the best of
    # {4, 0, 1} is 4, of {0, 1, 2} and {1, 2, 3} and {2, 3, 4} it is 2, of {3, 4, 0} it is 4.
    assert made.velocities.flatten().tolist() == [1.0, -1.5, 0.0, 2.0, 0.0]
    assert made.positions.flatten().tolist() == [1.0, 2.5, 1.0, -1.0, 2.0]
    better = made.remember(torch.tensor([[0.0, 2.5, 5.0, 4.0, 2.0]], dtype=torch.float64))
    assert better.tolist() == [[False, True, False, True, False]]
    assert made.best_positions.flatten().tolist() == [0.0, 2.5, 1.0, -1.0, 2.0]
    made.move(half, ones)
    # 0: 0.5 * 1 + 2 * 0.5 * (0 - 1) + (2 - 1), towards 4; 1: 0.5 * -1.5 + 0 + (1 - 2.5), towards 2;
    # 2: stays; 3: 0.5 * 2 + 0 + (1 + 1), towards 2; 4: 0 + 0 + (-1 - 2), towards 3 (4 > 3 > 1)
    assert made.velocities.flatten().tolist() == [0.5, -2.25, 0.0, 3.0, -3.0]
    assert made.positions.flatten().tolist() == [1.5, 0.25, 1.0, 2.0, -1.0]
    assert float(made.best[0, 0]) == 1.0


def test_velocities_and_positions_are_clipped() -> None:
    rule = SwarmRule(neighbourhood=3, inertia=1.0, own_pull=0.0, ring_pull=8.0)
    made = swarm(rule, [[[-2.0, 1.5], [-1.0, 0.0], [2.5, -0.25]]], -2.0, 2.0)
    assert made.positions[0, 2].tolist() == [2.0, -0.25], "the box holds from the beginning"
    made.remember(torch.tensor([[0.0, 9.0, 0.0]], dtype=torch.float64))
    ones = torch.ones(1, 3, 2)
    made.move(ones, ones)
    # 8 * (1, -1.5), nothing, 8 * (-3, 0.25), clipped to half the width of the box
    assert made.velocities[0].tolist() == [[2.0, -2.0], [0.0, 0.0], [-2.0, 2.0]]
    assert made.positions[0].tolist() == [[0.0, -0.5], [-1.0, 0.0], [0.0, 1.75]]
    made.move(torch.zeros(1, 3, 2), torch.zeros(1, 3, 2))
    assert made.velocities[0].tolist() == [[2.0, -2.0], [0.0, 0.0], [-2.0, 2.0]]
    assert made.positions[0].tolist() == [[2.0, -2.0], [-1.0, 0.0], [-2.0, 2.0]]


@pytest.mark.parametrize("limit", [0.03, 0.4, 1.0])
def test_no_velocity_exceeds_its_share_of_half_the_box(limit: float) -> None:
    low, high = -1.0, 3.0  # half the box: 2
    rule = replace(USUAL, velocity_limit=limit)
    rng = np.random.default_rng(1)
    made = swarm(rule, rng.uniform(low, high, (1, 8, 5)).tolist(), low, high)
    reached = []
    for _ in range(20):
        before = made.positions.clone()
        made.remember(torch.from_numpy(rng.normal(size=(1, 8))))
        made.move(*torch.from_numpy(rng.random((2, 1, 8, 5))))
        # one rounding of a double
        assert (made.positions - before).abs().max() <= 2.0 * limit + 1e-12
        reached.append(float(made.velocities.abs().max()))
    assert max(reached) == pytest.approx(2.0 * limit), "the limit must have been felt"


@pytest.mark.parametrize(("count", "neighbourhood"), [(7, 3), (200, 31), (5, 5)])
def test_news_travels_along_the_ring(count: int, neighbourhood: int) -> None:
    """Who is drawn to one good particle sits at most half a neighbourhood away from it."""
    rule = SwarmRule(neighbourhood, inertia=0.0, own_pull=0.0, ring_pull=1.0)
    places = torch.arange(count, dtype=torch.float64)
    for leader in (0, 2, count - 1):
        made = swarm(rule, [[[float(n)] for n in places]], -1e6, 1e6)
        fitness = torch.full((1, count), -1.0, dtype=torch.float64)
        fitness[0, leader] = 0.0
        made.remember(fitness)
        made.move(torch.zeros(1, count, 1), torch.ones(1, count, 1))
        followers = {n for n in range(count) if float(made.positions[0, n, 0]) == leader}
        reach = neighbourhood // 2
        expected = {(leader + step) % count for step in range(-reach, reach + 1)}
        assert followers == expected
        assert len(followers) == neighbourhood


def test_moves_by_plain_loops() -> None:
    lanes, count, width, low, high = 2, 6, 3, -1.0, 1.5
    rule = SwarmRule(neighbourhood=5, inertia=0.7, own_pull=1.4, ring_pull=1.6)
    rng = np.random.default_rng(0)
    x = rng.uniform(low, high, (lanes, count, width))
    made = swarm(rule, x.tolist(), low, high)
    v, best, known = np.zeros_like(x), x.copy(), np.full((lanes, count), -np.inf)
    hits = 0
    for _ in range(12):
        fitness = rng.normal(size=(lanes, count))
        own, ring = rng.random(x.shape), rng.random(x.shape)
        for lane in range(lanes):
            for n in range(count):
                if fitness[lane, n] > known[lane, n]:
                    known[lane, n], best[lane, n] = fitness[lane, n], x[lane, n]
            for n in range(count):
                near = [(n + step) % count for step in (-2, -1, 0, 1, 2)]
                leader = max(near, key=lambda m: known[lane, m])
                for d in range(width):
                    pull = 1.4 * own[lane, n, d] * (best[lane, n, d] - x[lane, n, d])
                    pull += 1.6 * ring[lane, n, d] * (best[lane, leader, d] - x[lane, n, d])
                    v[lane, n, d] = min(max(0.7 * v[lane, n, d] + pull, -1.25), 1.25)
                    moved = x[lane, n, d] + v[lane, n, d]
                    hits += not low < moved < high
                    x[lane, n, d] = min(max(moved, low), high)
        made.remember(torch.from_numpy(fitness))
        made.move(torch.from_numpy(own), torch.from_numpy(ring))
        # the same sums of doubles, perhaps in another order
        np.testing.assert_allclose(made.positions, x, rtol=0, atol=1e-12)
        np.testing.assert_allclose(made.velocities, v, rtol=0, atol=1e-12)
        np.testing.assert_allclose(made.best_positions, best, rtol=0, atol=1e-12)
        assert np.array_equal(made.best_fitness, known)
        leader_of = known.argmax(axis=1)
        np.testing.assert_allclose(made.best, best[[0, 1], leader_of], rtol=0, atol=1e-12)
    assert hits > 10, "the box must have been felt"


def test_only_what_is_better_is_remembered() -> None:
    made = swarm(USUAL, [[[0.0], [1.0], [2.0]]], -5.0, 5.0)
    assert float(made.best[0, 0]) == 0.0, "the first particle, before anything is known"
    nothing = torch.full((1, 3), torch.nan, dtype=torch.float64)
    assert not made.remember(nothing).any()
    assert made.best_fitness.isneginf().all()
    made.remember(torch.tensor([[1.0, 2.0, torch.nan]], dtype=torch.float64))
    beyond = torch.tensor([[torch.inf, -torch.inf, torch.inf]], dtype=torch.float64)
    assert not made.remember(beyond).any(), "infinity is no fitness either"
    made.positions += 10.0
    assert not made.remember(torch.tensor([[1.0, torch.nan, torch.nan]], dtype=torch.float64)).any()
    assert made.best_positions.flatten().tolist() == [0.0, 1.0, 2.0], "equal is not better"
    assert float(made.best[0, 0]) == 1.0


def sphere(x: Tensor) -> Tensor:
    return x.square().sum(dim=-1)


def rosenbrock(x: Tensor) -> Tensor:
    ahead, here = x[..., 1:], x[..., :-1]
    return (100.0 * (ahead - here.square()).square() + (1.0 - here).square()).sum(dim=-1)


CENTRE = torch.tensor([0.5, -0.25, 3.0, -7.0], dtype=torch.float64)


def shifted(x: Tensor) -> Tensor:
    return ((x - CENTRE).square() * torch.arange(1, 5)).sum(dim=-1)


KNOWN: list[tuple[Callable[[Tensor], Tensor], float, float, list[float], float]] = [
    # function, box, where its smallest value inside is, how near a thousand moves must come
    (sphere, -3.0, 5.0, [0.0] * 4, 1e-9),  # measured 1e-32
    (rosenbrock, -2.0, 2.0, [1.0] * 3, 0.1),  # measured 0.03 to 0.04, along its flat valley
    # The last two entries of the centre lie outside: there the box's sides are best. Measured 1e-7,
    # the square root of what doubles resolve.
    (shifted, -1.0, 1.0, [0.5, -0.25, 1.0, -1.0], 1e-5),
    (sphere, 1.0, 4.0, [1.0] * 4, 1e-9),  # measured 0
]


@pytest.mark.parametrize(("function", "low", "high", "minimum", "near"), KNOWN)
def test_known_minima_are_found_inside_and_on_the_box(
    function: Callable[[Tensor], Tensor],
    low: float,
    high: float,
    minimum: list[float],
    near: float,
) -> None:
    generator = torch.Generator().manual_seed(0)

    def uniform() -> Tensor:
        shape = (3, 30, len(minimum))
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    corner = torch.ones(3, len(minimum), dtype=torch.float64)
    rule = SwarmRule(7, USUAL.inertia, USUAL.own_pull, USUAL.ring_pull)
    made = Swarm(rule, low + (high - low) * uniform(), low * corner, high * corner)
    before = made.best_fitness.clone()
    for _ in range(1000):
        made.remember(-function(made.positions))
        assert (made.best_fitness >= before).all(), "personal bests never get worse"
        before = made.best_fitness.clone()
        assert torch.equal(before, -function(made.best_positions))
        made.move(uniform(), uniform())
        assert made.positions.min() >= low
        assert made.positions.max() <= high
        assert made.velocities.abs().max() <= (high - low) / 2.0
    assert (made.best - torch.tensor(minimum)).abs().max() < near


def test_swarms_do_not_feel_each_other_and_their_state_is_whole() -> None:
    generator = torch.Generator().manual_seed(1)
    first = torch.rand(3, 8, 5, generator=generator)
    numbers = [torch.rand(2, 3, 8, 5, generator=generator) for _ in range(10)]

    def moved(lanes: slice, made: Swarm, moves: list[Tensor]) -> Swarm:
        for own, ring in moves:
            made.remember(-sphere(made.positions - 0.3))
            made.move(own[lanes], ring[lanes])
        return made

    def fresh(lanes: slice) -> Swarm:
        corner = torch.ones_like(first[lanes, 0])
        return Swarm(USUAL, first[lanes], 0.0 * corner, corner)

    together = moved(slice(None), fresh(slice(None)), numbers)
    for lane in range(3):
        part = slice(lane, lane + 1)
        alone = moved(part, fresh(part), numbers)
        for name, tensor in alone.state_dict().items():
            assert torch.equal(tensor, together.state_dict()[name][part])
    halfway = moved(slice(None), fresh(slice(None)), numbers[:4])
    other = fresh(slice(None))
    other.load_state_dict({k: v.clone() for k, v in halfway.state_dict().items()})
    moved(slice(None), other, numbers[4:])
    for name, tensor in together.state_dict().items():
        assert torch.equal(tensor, other.state_dict()[name])
