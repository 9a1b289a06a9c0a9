"""The mis-calibration's potential and its latent oscillator."""

import math

import pytest

from components.environments.industrial.goldstone import (
    ALPHA,
    BETA,
    KAPPA,
    SAFE_ZONE,
    GoldstoneTables,
    decode_latents,
    encode_latents,
    latent_step,
    omega,
    potential,
)


def test_constants_are_the_published_ones() -> None:
    # the reference prints them with five digits
    assert pytest.approx(0.58491, abs=1e-5) == ALPHA
    assert pytest.approx(0.29245, abs=1e-5) == BETA
    assert pytest.approx(-0.63677, abs=1e-5) == KAPPA
    assert pytest.approx(0.1294, abs=1e-4) == SAFE_ZONE


@pytest.mark.parametrize("direction", range(-6, 7))
def test_potential_has_its_minimum_where_the_method_says(direction: int) -> None:
    rho = math.sin(math.pi * direction / 12.0)
    best = math.copysign(max(abs(rho), math.sin(math.radians(15.0))), rho)
    grid = [-1.5 + 0.001 * k for k in range(3001)]
    lowest = min(potential(direction, shift) for shift in grid)
    # the grid is at most 0.0005 from the minimum, where the curvature is below 60
    assert potential(direction, best) == pytest.approx(lowest, abs=1e-5)
    assert lowest >= -1.0 - 1e-12


def test_least_potential_is_minus_one() -> None:
    assert potential(6, 1.0) == pytest.approx(-1.0, abs=1e-12)  # rounding
    assert potential(-6, -1.0) == pytest.approx(-1.0, abs=1e-12)


@pytest.mark.parametrize("direction", range(-6, 7))
def test_omega_is_odd_continuous_and_reaches_two_at_two(direction: int) -> None:
    radius = max(abs(math.sin(math.pi * direction / 12.0)), math.sin(math.radians(15.0)))
    assert omega(direction, 2.0) == pytest.approx(2.0, abs=1e-12)
    assert omega(direction, -0.7) == -omega(direction, 0.7)
    # a power above one leaves the radius continuously
    assert omega(direction, radius + 1e-12) == pytest.approx(omega(direction, radius), abs=1e-9)


@pytest.mark.parametrize(
    ("before", "sign", "after"),
    [
        ((1, 1, 0), 1, (1, 1, 1)),  # turns with the shift
        ((1, 1, 0), -1, (-1, 1, -1)),  # domain follows the shift
        ((1, 1, 5), 1, (1, -1, 6)),  # at the edge the response turns bad
        ((1, -1, 6), 1, (1, -1, 5)),  # and the direction comes back
        ((1, -1, -6), 1, (1, -1, -6)),  # the far edge holds
        ((1, -1, 3), -1, (-1, 1, 2)),  # a domain change heals the response
        ((1, 1, 6), 1, (1, -1, 5)),  # beyond the edge: mirrored
        ((-1, -1, 4), 0, (-1, -1, 3)),  # in the safe zone towards zero
        ((-1, -1, 1), 0, (1, 1, 0)),  # a full circle resets
        ((-1, -1, -1), 1, (1, 1, 0)),  # zero outside the safe zone resets nothing but the domain
    ],
)
def test_latent_step(before: tuple[int, int, int], sign: int, after: tuple[int, int, int]) -> None:
    assert latent_step(*before, sign) == after


def test_tables_say_what_the_functions_say() -> None:
    tables = GoldstoneTables.build()
    for state in range(52):
        latents = decode_latents(state)
        assert encode_latents(*latents) == state
        for sign in (-1, 0, 1):
            following = int(tables.transition[3 * state + 1 + sign])
            assert decode_latents(following // 3) == latent_step(*latents, sign)
            assert following % 3 == 1


@pytest.mark.parametrize("latents", [(0, 1, 0), (1, 2, 0), (1, 1, 7)])
def test_impossible_latents_are_refused(latents: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="does not exist"):
        encode_latents(*latents)
