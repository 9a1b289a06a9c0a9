"""Updates that are replayed as graphs do what ordinary ones do; skipped where there is no GPU.

What does not need a GPU is in `test_recorded.py`.
"""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from components.algorithms import ALGORITHMS
from components.core.draws import Normal
from components.core.random_streams import LaneStreams
from components.models.recurrent_ensemble import fit as recurrent_fit
from components.models.recurrent_ensemble.ensemble import RecurrentEnsembleConfig
from components.models.recurrent_ensemble.windows import TrainingWindows
from components.models.supervised import StackedFit
from components.training.cuda_graphs import CudaGraphs, GraphedLearner, lost_graphs
from components.training.loop import TrainingLoop
from tests.components.algorithms.stacks import learner
from tests.components.models.test_supervised import Points, pulled
from tests.components.synthetic import keys, make_log

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no GPU"),
]
GPU = torch.device("cuda")
LOG = make_log()
UPDATES = 120


def compare(make: Callable[[], Any]) -> None:
    """Train two of a kind, one by graphs: the same kernels, in workspaces of their own."""
    ordinary, graphed = make(), GraphedLearner(make(), CudaGraphs(GPU))
    before = {key: tensor.clone() for key, tensor in ordinary.state_dict().items()}
    for step in range(UPDATES):
        expected = ordinary.update(step)
        found = graphed.update(step)
        assert found.keys() == expected.keys()
        for metric, value in expected.items():
            torch.testing.assert_close(found[metric], value, msg=f"{metric} at {step}")
    assert graphed.captured >= 1
    state = graphed.state_dict()
    for key, tensor in ordinary.state_dict().items():
        torch.testing.assert_close(state[key], tensor, msg=key)
    assert any(not torch.equal(tensor, before[key]) for key, tensor in state.items())


@pytest.mark.parametrize("name", ALGORITHMS)
def test_replayed_updates_are_the_ordinary_ones(name: str) -> None:
    compare(lambda: learner(name, [LOG] * 3, range(3), device=GPU))


@pytest.mark.parametrize("tf32", [False, True])
def test_all_learners_are_captured_in_one_process(tf32: bool) -> None:
    torch.backends.cuda.matmul.allow_tf32 = tf32
    try:
        with lost_graphs() as lost:
            for name in ALGORITHMS:
                made = learner(name, [LOG] * 3, range(3), device=GPU)
                graphs = GraphedLearner(made, CudaGraphs(GPU))
                TrainingLoop(UPDATES, "abc", log_every=20).run(graphs, at=())
                assert graphs.captured, name
    finally:
        torch.backends.cuda.matmul.allow_tf32 = False
    assert lost == []


def test_replayed_fits_follow_their_schedules() -> None:
    def fit() -> StackedFit[Points]:
        streams = LaneStreams(keys("a", "b"), {"place": Normal(2, 3)}, GPU)
        made = StackedFit(
            Points(2).to(GPU), 2, pulled, streams, learning_rate=0.1, schedule="cosine"
        )
        made._updates = UPDATES
        return made

    compare(fit)


def test_replayed_recurrent_fits_do_too() -> None:
    config = RecurrentEnsembleConfig(
        members=2, hidden=8, warm_up=3, horizon=5, updates=UPDATES, batch=16
    )
    windows = TrainingWindows(LOG, config, GPU)
    compare(lambda: recurrent_fit._EnsembleLearner(windows, config, 1, GPU))


def test_what_cannot_be_captured_goes_on_as_it_is() -> None:
    class Waiting(StackedFit[Points]):
        def update(self, step: int) -> dict[str, torch.Tensor]:
            made = super().update(step)
            float(made["mean"].sum())
            return made

    def fit(kind: type) -> StackedFit[Points]:
        streams = LaneStreams(keys("a", "b"), {"place": Normal(2, 3)}, GPU)
        made: StackedFit[Points] = kind(Points(2).to(GPU), 2, pulled, streams, learning_rate=0.1)
        return made

    plain, waiting = fit(StackedFit), GraphedLearner(fit(Waiting), CudaGraphs(GPU))

    def train() -> None:
        for step in range(10):
            expected, found = plain.update(step), waiting.update(step)
            torch.testing.assert_close(found["model/train_loss"], expected["model/train_loss"])

    with pytest.warns(UserWarning, match="No CUDA graph for updates of .*captur"):
        train()
    assert waiting.captured == 0
