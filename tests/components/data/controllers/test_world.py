"""The controller of the 2-D world."""

import numpy as np

from components.data.controllers.world import to_nearest

GOALS = ((2.5, 2.5), (7.5, 7.5))


def test_it_goes_to_the_nearer_goal_and_hits_it_exactly() -> None:
    places = np.array([[0.0, 0.0], [2.0, 3.25], [7.5, 7.5], [9.0, 8.0], [5.1, 5.0], [-30.0, 2.5]])
    expected = [[1.0, 1.0], [0.5, -0.75], [0.0, 0.0], [-1.0, -0.5], [1.0, 1.0], [1.0, 0.0]]
    np.testing.assert_allclose(to_nearest(places, GOALS), expected, rtol=1e-12)  # rounding


def test_of_equally_near_goals_the_first_is_taken() -> None:
    assert to_nearest(np.array([[5.0, 5.0]]), GOALS).tolist() == [[-1.0, -1.0]]
