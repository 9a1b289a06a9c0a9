"""Errors on logged actions, by a loop over single states."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from components.judging import imitation
from components.judging.imitation import imitation_errors
from components.policies.policy import Policy
from tests.components.synthetic import make_log, policy_card, random_policy

LOG = make_log()


def test_errors_are_those_of_every_logged_action(monkeypatch: pytest.MonkeyPatch) -> None:
    """In parts that do not divide the log, over episodes that begin with repeated frames."""
    monkeypatch.setattr(imitation, "_AT_ONCE", 7)
    policies = [random_policy(LOG, name) for name in "ab"]
    stack = Policy.concatenate(policies[0].card, policies)
    history, starts = stack.card.history, LOG.episode_starts
    by_hand = np.zeros(2)
    for episode, (first, end) in enumerate(pairwise(starts)):
        for row in range(first, end):
            newest = row + episode  # every episode has a frame more than transitions
            lags = [max(newest - lag, first + episode) for lag in range(history)]
            seen = torch.from_numpy(LOG.frames[lags])[None, None]
            for lane, policy in enumerate(policies):
                action = policy.act(seen)[0, 0].numpy()
                by_hand[lane] += np.square(action - LOG.actions[row]).sum()
    by_hand /= LOG.actions.size
    # float32 products of batches of other sizes
    np.testing.assert_allclose(imitation_errors(stack, LOG), by_hand, rtol=1e-5)
    assert by_hand[0] != pytest.approx(by_hand[1])


def test_policies_that_take_the_proximity_are_asked_at_zero() -> None:
    """With weights of 0 a policy of any proximity does 0: the error is the mean squared action."""
    width = LOG.card.history * LOG.frames.shape[1] + 1
    layer = (torch.zeros(1, width, 3), torch.zeros(1, 1, 3))
    layer[0][0, -1] = 5.0  # the proximity alone moves it
    steered = Policy.of_networks(
        policy_card(LOG, takes_proximity=True), {"actor": [layer]}, random_policy(LOG, "a").frames
    )
    at_zero = np.tanh(5.0 * (0.0 - 0.5) / np.sqrt(1.0 / 12.0))  # the proximity enters standardised
    expected = np.square(at_zero - LOG.actions).mean()
    assert imitation_errors(steered, LOG)[0] == pytest.approx(expected, rel=1e-4)  # float32
