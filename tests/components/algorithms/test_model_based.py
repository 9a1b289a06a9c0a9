"""The unconstrained control: its loss by plain loops, and that nothing holds it."""

from typing import Any

import numpy as np
import pytest
import torch

from components.algorithms import model_based
from components.algorithms.parts.learner import LearnerInputs
from components.core.normaliser import Normaliser
from components.data.batches import LaneData
from tests.components.algorithms.stacks import SMALL, learner, run
from tests.components.algorithms.test_lion import STEPS, arrays, history_of
from tests.components.algorithms.test_wsbc import consuming, virtual_return
from tests.components.synthetic import CPU, make_log, policy_card, random_ensemble, random_policy

LOG = make_log()


def test_loss_of_an_update_by_plain_loops() -> None:
    made = learner("model_based", [LOG] * 2, [0, 1])
    start = made._streams.at(0)["start"].clone()
    before = made.policy(policy_card(LOG))
    metrics = made.update(0)
    for lane in range(2):
        policy = before.lane(lane, before.card)
        scaling = Normaliser(policy.frames.mean[0], policy.frames.scale[0])
        ensemble = random_ensemble(LOG, "toy")
        returns = [
            virtual_return(arrays(policy.layers), scaling, ensemble, history_of(int(row)))
            for row in start[lane]
        ]
        mean = np.mean(returns)
        # float32 through five recurrent steps; the card's mean return is -50
        assert float(metrics["policy/virtual_return"][lane]) == pytest.approx(mean, rel=1e-4)
        assert float(metrics["policy/loss"][lane]) == pytest.approx(-mean / 50.0, rel=1e-4)


def test_the_step_follows_the_gradient_of_that_loss() -> None:
    made = learner("model_based", [LOG], [0])
    start = made._streams.at(0)["start"].clone()
    bias = made._actor.affine()[-1][1]

    def loss() -> float:
        with torch.no_grad():
            returns = made._returns.of(start, lambda seen: torch.tanh(made._actor(seen)))
            return float(-returns.mean())

    differences = []
    for entry in range(3):
        ends = []
        for sign in (1, -1):
            with torch.no_grad():
                bias[0, 0, entry] += sign * 1e-2
                ends.append(loss())
                bias[0, 0, entry] -= sign * 1e-2
        differences.append((ends[0] - ends[1]) / 2e-2)
    made.update(0)
    # central differences of a float32 loss near 0.2, over a step of 0.02
    np.testing.assert_allclose(bias.grad[0, 0], differences, rtol=0.05, atol=3e-5)


def test_start_states_are_early_ones() -> None:
    made = learner("model_based", [LOG], [0], trajectories=300, start_window=4)
    # 300 draws of 4: one is missed with chance 1e-37
    assert set((made._streams.at(0)["start"][0] % STEPS).tolist()) == {0, 1, 2, 3}


@pytest.mark.slow(1)
def test_nothing_holds_it_near_the_data() -> None:
    """Where less velocity is all that counts it ends on the bound, whatever the log did."""
    inputs = LearnerInputs(
        data=LaneData([LOG], CPU), keys=[3], models={"recurrent_ensemble": [consuming()]}
    )
    settings = SMALL["model_based"] | {"learning_rate": 5e-3, "hidden": (16,), "trajectories": 20}
    made = model_based.Learner(model_based.Config(**settings), inputs)
    start = torch.arange(0, LOG.transitions, 5)[None]

    def mean_return() -> float:
        with torch.no_grad():
            returns = made._returns.of(start, lambda seen: torch.tanh(made._actor(seen)))
            return 50.0 * float(returns.mean())

    at_first = mean_return()
    metrics = run(made, 200)
    assert mean_return() > at_first + 0.04  # measured 0.071 to 0.097 more, to -10.354
    histories = torch.from_numpy(LOG.frames[:60].reshape(1, 20, 3, 6).copy())
    actions = made.policy(policy_card(LOG)).act(histories)[0]
    logged = random_policy(LOG, ("toy",)).act(histories)[0]
    # with three seeds measured -0.985 to -0.993, 0.34 to 0.80 and 1.4 to 1.5
    assert actions[:, 0].mean() < -0.95
    assert metrics[-1]["policy/saturated_share"].item() > 0.2
    assert (actions - logged).norm(dim=1).mean() > 0.7


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"updates": 0}, "must be at least 1"),
        ({"hidden": (8, 0)}, "must be at least 1"),
        ({"learning_rate": 0.0}, "learning_rate must be positive, got 0.0"),
        ({"discount": 1.5}, r"discount must lie in \(0, 1\], got 1.5"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        model_based.Config(**changes)
