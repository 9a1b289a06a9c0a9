"""Neighbourhoods: distances in units of the rows' deviations, and what is outside."""

import numpy as np

from components.data.neighbourhood import Neighbourhood


def test_distances_are_in_units_of_the_rows_own_deviations() -> None:
    rows = np.array([[0.0, 0.0], [2.0, 200.0]])  # deviations 1 and 100
    near = Neighbourhood(rows, 1.0)
    others = np.array([[0.0, 50.0], [2.0, 500.0], [0.0, 0.0]])
    np.testing.assert_allclose(near.distances(others), [0.5, 3.0, 0.0])
    assert near.outside(others).tolist() == [False, True, False]
    assert near.distances(others[None]).shape == (1, 3)


def test_the_widest_of_the_familiar_decides_the_limit() -> None:
    rows = np.linspace(0, 1, 11)[:, None]
    deviation = rows.std()
    near, far = np.array([[1.1]]), np.array([[1.5]])
    assert np.isclose(Neighbourhood.around(rows, (near,), 0.9).limit, 0.1 / deviation)
    assert np.isclose(Neighbourhood.around(rows, (near, far), 0.9).limit, 0.5 / deviation)


def test_a_column_that_never_changes_makes_another_value_strange() -> None:
    rows = np.array([[70.0, 0.0], [70.0, 1.0]])
    assert Neighbourhood(rows, 0.5).outside(np.array([[71.0, 0.0], [70.0, 0.1]])).tolist() == [
        True,
        False,
    ]
