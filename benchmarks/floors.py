"""Floors: what a computer's arithmetic and memory allow at best.

The matrix rate is that of one large product of float32 inputs, the bandwidth that of one large
copy, both measured, best of several, with the threads of the measurement. The work of an update is
counted once, with one lane on the CPU: matrix products by PyTorch's counter of operations, and as
memory traffic every stored number that an update changes (weights, targets, moments), read once and
written once. Lanes multiply both. What is left out (element-wise work, activations, gathering,
draws) makes the floor lower than any program can be, and numbers that fit into a processor's cache
may move faster than the bandwidth of its memory.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch.utils.flop_counter import FlopCounterMode

from components.training.loop import Learner

__all__ = ["Limits", "Work", "operations", "work_of_updates"]


@dataclass(frozen=True)
class Limits:
    """What the computer does at best.

    Attributes:
        matrix_rate: Operations of matrix products per second.
        bandwidth: Bytes per second, read and written ones together.
    """

    matrix_rate: float
    bandwidth: float

    @classmethod
    def measured(cls, device: torch.device, quick: bool = False) -> "Limits":
        """Measure both, in less than a second or two."""
        on_a_gpu = device.type == "cuda"
        size = 256 if quick else (8192 if on_a_gpu else 1536)
        count = 2**20 if quick else (2**28 if on_a_gpu else 2**25)
        before = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("high")  # TF32 where there is such a unit
        try:
            left, right = (torch.randn(size, size, device=device) for _ in range(2))
            matrix = _best(lambda: torch.mm(left, right), on_a_gpu)
        finally:
            torch.set_float32_matmul_precision(before)
        source = torch.zeros(count, device=device)
        target = torch.zeros_like(source)
        copy = _best(lambda: target.copy_(source), on_a_gpu)
        return cls(2.0 * size**3 / matrix, 2.0 * 4.0 * count / copy)


@dataclass(frozen=True)
class Work:
    """Operations of matrix products, and bytes read and written."""

    operations: float
    traffic: float = 0.0

    def floor(self, limits: Limits, times: float = 1.0) -> tuple[float, str]:
        """Least seconds for this work done `times` over, and which of the two limits sets them."""
        matrix = times * self.operations / limits.matrix_rate
        memory = times * self.traffic / limits.bandwidth
        return max((matrix, "matrix products"), (memory, "memory"))


def _best(run: Callable[[], object], on_a_gpu: bool, repetitions: int = 7) -> float:
    seconds = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        run()
        if on_a_gpu:
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


def operations(run: Callable[[], object]) -> float:
    """Operations of all matrix products in a run, two per multiplication and addition."""
    with FlopCounterMode(display=False) as counter:
        run()
    return float(counter.get_total_flops())


def work_of_updates(learner: Learner, steps: Sequence[int]) -> Work:
    """Mean work of an update of a learner on the CPU, over some steps."""
    before = {name: tensor.clone() for name, tensor in learner.state_dict().items()}
    counted, moved = 0.0, 0
    for step in steps:
        counted += operations(lambda step=step: learner.update(step))
        after = learner.state_dict()
        for name, tensor in after.items():
            if name not in before or not torch.equal(before[name], tensor):
                moved += tensor.numel() * tensor.element_size()
        before = {name: tensor.clone() for name, tensor in after.items()}
    return Work(counted / len(steps), 2.0 * moved / len(steps))
