"""Whatever an algorithm does, no policy with undefined numbers or actions is published.

Every algorithm is driven out of range by its rates, and by a log that no reader would let through.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from components.algorithms import ALGORITHMS
from components.algorithms.parts.training import train_policies
from components.data.dataset import OfflineDataset
from components.policies.policy import Policy
from components.training.divergence import DivergedError
from tests.components.algorithms.stacks import config, graded, learner
from tests.components.synthetic import make_log, relabelled

LOG = make_log()
UPDATES, SNAPSHOTS = 12, 3
EXTREMES: dict[str, dict[str, Any]] = {  # of those without a learning rate that reaches the policy
    "wsbc": {"box": 1e30},
    "morel": {"step_size": 1e30},
}
every_algorithm = pytest.mark.parametrize("name", graded(ALGORITHMS, 1))


def trained(
    name: str, log: OfflineDataset, work: Path, **changes: Any
) -> tuple[Policy | DivergedError, Path]:
    """The lane's policy, and the folder of its snapshots."""
    [policy], _ = train_policies(
        ALGORITHMS[name],
        learner(name, [log], [0], **changes),
        [log],
        ["a"],
        updates=UPDATES,
        snapshots=SNAPSHOTS,
        work=work,
        progress=lambda fraction: None,
    )
    return policy, work


def assert_publishable(policy: Policy) -> None:
    assert policy.finite.all()
    card = policy.card
    rows = LOG.frame_rows()[None, :, None] * np.ones((policy.lanes, 1, card.history), np.int64)
    histories = torch.from_numpy(LOG.frames[rows])
    shape = histories.shape[:2]
    proximity = torch.rand(shape) if card.takes_proximity else None
    noise = torch.zeros(*shape, card.candidates, card.noise) if card.candidates else None
    assert policy.act(histories, proximity, noise).isfinite().all()


@every_algorithm
def test_rates_far_out_of_range(name: str, tmp_path: Path) -> None:
    fields = [field.name for field in dataclasses.fields(config(name))]
    rates = {field: 1e30 for field in fields if field.endswith("learning_rate")}
    changes = rates | EXTREMES.get(name, {})
    assert changes, "something drives it out of range"
    policy, work = trained(name, LOG, tmp_path, **changes)
    stored = [Policy.load(folder) for folder in work.glob("snapshot-*/a")]
    assert len(stored) == SNAPSHOTS + 1
    assert all(snapshot.finite.all() for snapshot in stored)
    if isinstance(policy, DivergedError):
        assert "before the first snapshot at update" in str(policy)
        assert "\n" not in str(policy)
    else:
        assert_publishable(policy)


@every_algorithm
@pytest.mark.parametrize("array", ["frames", "rewards", "actions"])
def test_a_poisoned_log(name: str, array: str, tmp_path: Path) -> None:
    values = LOG.arrays()[array].copy()
    values[100] = np.nan
    policy: Policy | Exception
    try:
        policy, _ = trained(name, relabelled(LOG, **{array: values}), tmp_path)
    except ValueError as error:
        policy = error
    if isinstance(policy, Policy):
        assert_publishable(policy)
    else:
        assert "\n" not in str(policy)
