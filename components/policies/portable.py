"""A deployed policy as one module that needs nothing else: raw frames in, the plant's units out.

What it computes is traced from :meth:`components.policies.policy.Policy.act` itself, so there is no
second implementation of how a policy acts. Inputs and output, B machines at once:

- ``history [B, H, F]``: raw frames in the units of the log, the newest first;
- ``proximity [B]`` in [0, 1], only of policies that take it;
- ``noise [B, N, E]``: standard normal numbers from which N candidates are made, only of policies
  that choose among candidates (BCQ, BEAR). Whoever runs the file draws them anew at every step.
  Numbers fixed inside of it would make another policy, one that always tries the same candidates,
  and a generator inside of it could not be compared with the original;
- ``action [B, A]``: in the units of the plant where the log knows the bounds, else in [-1, 1].
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from components.policies.card import PolicyCard
from components.policies.policy import Policy

__all__ = ["BATCH", "Plant", "PortablePolicy", "input_shapes", "traced"]

BATCH = "batch"
"""Name of the axis of machines, which may have any length."""


@dataclass(frozen=True, kw_only=True)
class Plant:
    """What the card of a log says of the machine behind it.

    Attributes:
        actions: Names of the A actions.
        bounds: Smallest and largest value of each in the units of the plant; empty: actions stay in
            [-1, 1].
        sampling: Interval of the frames; 0 where it is not known.
        log_digest: Of the log's arrays; empty where the log is not known.
    """

    actions: tuple[str, ...]
    bounds: tuple[tuple[float, float], ...] = ()
    sampling: float = 0.0
    log_digest: str = ""

    @property
    def limits(self) -> npt.NDArray[np.float64]:
        """``[A, 2]`` what an action of -1 and of 1 is on the plant."""
        return np.array(self.bounds or [(-1.0, 1.0)] * len(self.actions))


class PortablePolicy(nn.Module):
    """One policy with everything that it needs, as buffers.

    Args:
        policy: A stack of one.
        plant: Whose units the actions get.
    """

    middle: Tensor
    reach: Tensor

    def __init__(self, policy: Policy, plant: Plant) -> None:
        super().__init__()
        self._card = policy.card
        self._names = {name: name.replace(".", "_") for name in policy.tensors()}
        for name, tensor in policy.tensors().items():
            self.register_buffer(self._names[name], tensor)
        self._has_units = bool(plant.bounds)
        low, high = torch.from_numpy(plant.limits).T
        self.register_buffer("middle", ((low + high) / 2).float())
        self.register_buffer("reach", ((high - low) / 2).float())

    def forward(
        self, history: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions ``[B, A]``, see the module."""
        tensors = {name: self.get_buffer(own) for name, own in self._names.items()}
        chosen = Policy.of_tensors(self._card, tensors).act(
            history[None],
            None if proximity is None else proximity[None],
            None if noise is None else noise[None],
        )[0]
        return self.middle + self.reach * chosen if self._has_units else chosen


def input_shapes(card: PolicyCard) -> dict[str, tuple[int, ...]]:
    """Names of the inputs and their shapes after the axis of machines."""
    shapes: dict[str, tuple[int, ...]] = {"history": (card.history, len(card.features))}
    if card.takes_proximity:
        shapes["proximity"] = ()
    if card.candidates:
        shapes["noise"] = (card.candidates, card.noise)
    return shapes


def traced(policy: Policy, plant: Plant) -> tuple[ExportedProgram, dict[str, Any]]:
    """The module as a graph of PyTorch's operations, for any number of machines.

    Args:
        policy: A stack of one.
        plant: Whose units the actions get.

    Returns:
        The program, which takes its inputs by name, and the shapes it was traced for.
    """
    shapes = input_shapes(policy.card)
    # two machines: PyTorch takes an axis of length one for a constant
    examples = {name: torch.zeros(2, *shape) for name, shape in shapes.items()}
    batch = Dim(BATCH)
    dynamic = {name: {0: batch} for name in shapes}
    module = PortablePolicy(policy, plant).eval()
    with torch.no_grad():
        program = torch.export.export(module, (), examples, dynamic_shapes=dynamic)
    for node in program.graph.nodes:
        node.meta.pop("stack_trace", None)  # names files of this computer
    return program, dynamic
