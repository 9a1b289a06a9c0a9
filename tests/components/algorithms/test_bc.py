"""Plain cloning."""

import numpy as np
import pytest
import torch

from tests.components.algorithms.plain import floats, network
from tests.components.algorithms.stacks import learner, run
from tests.components.synthetic import controller, make_log, policy_card


def test_loss_is_the_mean_squared_distance_over_batch_and_entries() -> None:
    made = learner("bc", [make_log()] * 2, [0, 1])
    rows = made._streams.at(0)["row"].clone()
    observations, actions = made._data.observations(rows), made._data.actions(rows)
    expected = []
    for lane in range(2):
        total = 0.0
        for seen, action in zip(floats(observations)[lane], floats(actions)[lane], strict=True):
            chosen = np.tanh(network(made._actor, lane, seen[None])[0])
            total += np.sum((chosen - action) ** 2)
        expected.append(total / (16 * 3))
    metrics = made.update(0)
    # float32
    assert metrics["actor/imitation_error"].tolist() == pytest.approx(expected, rel=1e-5)


def test_saturated_share_counts_entries_beyond_0_99() -> None:
    made = learner("bc", [make_log()] * 2, [0, 1])
    with torch.no_grad():
        last = made._actor.layers[-1]
        last.weight.zero_()
        # tanh 2.6 is 0.989 and tanh 2.7 is 0.991
        last.bias.copy_(torch.tensor([[[2.6, 2.7, -2.7]], [[0.0, 2.6, -2.6]]]))
    assert made.update(0)["actor/saturated_share"].tolist() == pytest.approx([2 / 3, 0.0])


def test_learns_the_operator_and_deploys_it() -> None:
    log = make_log(episodes=20, explore=0.0)
    made = learner("bc", [log], [0], learning_rate=3e-3, batch=64, hidden=(32,))
    metrics = run(made, 1000)
    errors = torch.stack([m["actor/imitation_error"] for m in metrics])
    # measured 0.020 at first and 0.00002 at last
    assert errors[0] > 0.01
    assert errors[-50:].mean() < 0.0005
    frames = torch.from_numpy(log.frames[:40])  # the first episode
    histories = frames[:, None].expand(-1, 3, -1)[None]
    found = made.policy(policy_card(log)).act(histories)[0].numpy()
    wanted = controller(log.frames[:40, 1:4].astype(np.float64))
    # histories of one repeated frame were logged only at starts; measured 0.013, at most 0.050
    assert np.abs(found - wanted).max() < 0.15


def test_of_a_mixture_it_learns_the_mean() -> None:
    log = make_log(episodes=40, explore=0.5)
    made = learner("bc", [log], [0], learning_rate=3e-3, batch=64, hidden=(32,))
    run(made, 600)
    found = torch.tanh(made._actor(made._data.observations(torch.arange(1600)[None])))[0]
    frames = log.frames.reshape(40, 41, 6)[:, :-1].reshape(-1, 6)
    wanted = controller(frames[:, 1:4].astype(np.float64))
    # half of the actions are the operator's, the mean of the others is 0
    share = np.sum(floats(found) * wanted) / np.sum(wanted**2)
    # measured 0.475 here and up to 0.56 with other logs; 0.27 before training
    assert share == pytest.approx(0.5, abs=0.12)
