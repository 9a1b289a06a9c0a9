"""A lane of a stack learns what it would learn alone; equal seeds, equal numbers."""

from collections.abc import Sequence
from typing import Any

import pytest
import torch

from components.algorithms import ALGORITHMS
from components.data.dataset import OfflineDataset
from tests.components.algorithms.stacks import learner, run
from tests.components.robot import make_robot_log
from tests.components.synthetic import make_log

LOG = make_log()
OTHER = make_log("other", seed=5, explore=0.2)
ROBOT = make_robot_log()
OTHER_ROBOT = make_robot_log("robot2", seed=5, episodes=19)
UPDATES = 200
every_algorithm = pytest.mark.parametrize("name", ALGORITHMS)
# Those with a model environment meet another one on a robot: its own past, its own end.
HYBRIDS = ("lion", "wsbc", "mopo")
in_their_worlds = pytest.mark.parametrize(
    ("name", "logs"),
    [
        pytest.param(name, logs, id=f"{name}-{logs[0].card.name}")
        for logs, names in (((LOG, OTHER), ALGORITHMS), ((ROBOT, OTHER_ROBOT), HYBRIDS))
        for name in names
    ],
)

# Stacked and single products may sum in another order, and Adam turns a difference in a tiny
# gradient into one of the step's size: after 200 updates at rate 1e-3 float32 leaves this much.
CLOSE = {"rtol": 1e-2, "atol": 1e-3}


def lane_state(made: object, lane: int) -> dict[str, torch.Tensor]:
    state = made.state_dict()  # type: ignore[attr-defined]
    return {
        name: tensor.view(made.lanes, -1)[lane]  # type: ignore[attr-defined]
        for name, tensor in state.items()
    }


def networks(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: tensor for name, tensor in state.items() if "optimizer" not in name}


@pytest.mark.slow(4)
@in_their_worlds
def test_lanes_of_a_stack_equal_each_alone(
    name: str, logs: tuple[OfflineDataset, OfflineDataset]
) -> None:
    """Beside other seeds of the same dataset, and beside another dataset."""

    def trained(logs: Sequence[OfflineDataset], seeds: Sequence[int]) -> Any:
        made = learner(name, logs, seeds)
        run(made, UPDATES)
        return made

    seeds, datasets = trained([logs[0]] * 3, [0, 1, 2]), trained(logs, [1, 0])
    fresh = {k: v.clone() for k, v in networks(lane_state(learner(name, logs[:1], [1]), 0)).items()}
    one, other = trained(logs[:1], [1]), trained(logs[1:], [0])
    for alone, stack, lane in ((one, seeds, 1), (one, datasets, 0), (other, datasets, 1)):
        moved = networks(lane_state(stack, lane))
        for key, tensor in networks(lane_state(alone, 0)).items():
            torch.testing.assert_close(tensor, moved[key], **CLOSE)
    # The tolerance means something only where training has moved the weights much further. What
    # merely fills up, a ring of transitions or fitness from minus infinity on, shows no learning.
    moved = networks(lane_state(one, 0))
    learned = [k for k, v in fresh.items() if v.isfinite().all() and not k.startswith("buffer.")]
    assert max(float((moved[key] - fresh[key]).abs().max()) for key in learned) > 0.05


@every_algorithm
def test_equal_seeds_give_equal_numbers_and_others_do_not(name: str) -> None:
    stacks = [learner(name, [LOG] * 2, seeds) for seeds in ([0, 1], [0, 1], [0, 2])]
    for made in stacks:
        run(made, 20)
    first, again, other = ([lane_state(made, lane) for lane in (0, 1)] for made in stacks)
    for lane in (0, 1):
        for key, tensor in first[lane].items():
            assert torch.equal(tensor, again[lane][key])
    # A detector belongs to the dataset and its models, not to the seed; nothing ends here.
    shared = ("detector.", "buffer.ended")
    own = {k: v for k, v in networks(first[1]).items() if not k.startswith(shared)}
    different = [k for k, v in own.items() if not torch.equal(v, other[1][k])]
    assert len(different) == len(own)
