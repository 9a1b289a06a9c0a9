"""Whether a file acts as the policy that it was made from, on recorded states.

The original and the file compute the same sums of float32 numbers in another order, so their
actions differ in the last digits: by some 1e-7 of half an action's range, as measured on all
algorithms. A file may differ by `TOLERANCE`, which leaves room for larger networks and is far below
what moves a machine. An action in the units of a plant is moreover rounded to float32 there.

Policies that choose among candidates jump where two candidates are equally good: there the last
digits decide. Where the file chose another candidate, the original's critic must find it as good,
up to `TOLERANCE` of its value, and the state is counted as a tie.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch

from components.core.random_streams import lane_generator, lane_key
from components.policies.policy import Policy
from components.policies.portable import Plant, input_shapes

__all__ = ["TOLERANCE", "Checked", "States", "compare", "drawn_states"]

TOLERANCE: Final = 1e-5
"""Largest difference of an action, as a share of half its range."""
PROXIMITIES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
_BATCH: Final = 100  # candidates of more states at once take too much memory
_DRAWN: Final = 1000

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class States:
    """Histories to act in.

    Attributes:
        histories: ``[n, H, F]`` raw frames, the newest first.
        source: What they are, for the card of a file.
    """

    histories: Floats
    source: str


@dataclass(frozen=True)
class Checked:
    """How well a file agrees.

    Attributes:
        states: Number of states.
        actions: Number of actions that were compared: of all states at all proximities.
        difference: Largest one of an action, as a share of half its range, without ties.
        ties: Actions that are another candidate, as good to the critic.
    """

    states: int
    actions: int
    difference: float
    ties: int

    def __str__(self) -> str:
        ties = f", {self.ties} ties between candidates" if self.ties else ""
        return (
            f"{self.actions} actions in {self.states} states differ by at most "
            f"{self.difference:.1e} of half their range (allowed {TOLERANCE:g}){ties}"
        )


def drawn_states(policy: Policy) -> States:
    """States where no log is at hand: normal numbers with the moments of the policy's own scaling.

    Args:
        policy: A stack of one.
    """
    card = policy.card
    generator = lane_generator(lane_key("portable states", card.algorithm, card.dataset))
    shape = (_DRAWN, card.history, len(card.features))
    mean, scale = policy.frames.mean[0].numpy(), policy.frames.scale[0].numpy()
    drawn = mean + scale * generator.standard_normal(shape, np.float32)
    return States(drawn, "drawn from the moments of the policy's scaling")


def compare(
    policy: Policy, plant: Plant, run: Callable[[Mapping[str, Floats]], Floats], states: States
) -> Checked:
    """Let the file and the original act in the same states.

    Args:
        policy: The original, a stack of one.
        plant: Whose units the file's actions have.
        run: The file, from inputs by name to actions ``[B, A]``.
        states: Where to act, at several proximities if the policy takes one. The first is
            handed over alone, as on a plant, the others many at once.

    Raises:
        ValueError: They differ by more than is allowed, or the file's actions are not finite.
    """
    histories = states.histories
    levels = PROXIMITIES if policy.card.takes_proximity else (0.0,)
    seen = np.tile(histories, (len(levels), 1, 1))
    proximity = np.repeat(np.array(levels, np.float32), len(histories))
    noise = lane_generator(lane_key("portable noise"))
    worst, ties = 0.0, 0
    for first, last in _batches(len(seen)):
        inputs: dict[str, Any] = {"history": seen[first:last], "proximity": proximity[first:last]}
        shapes = input_shapes(policy.card)
        if "noise" in shapes:
            inputs["noise"] = noise.standard_normal((last - first, *shapes["noise"]), np.float32)
        inputs = {name: inputs[name] for name in shapes}
        off, tied = _differences(policy, plant, run(inputs), inputs)
        ties += int(tied.sum())
        worst = max(worst, float(off.max(initial=0.0)))
        if not worst <= TOLERANCE:
            raise ValueError(
                f"differs from the policy by {worst:.1e} of half an action's range, and "
                f"{TOLERANCE:g} is allowed"
            )
    return Checked(len(histories), len(seen), worst, ties)


def _batches(number: int) -> list[tuple[int, int]]:
    edges = [0, *range(1, number, _BATCH), number]
    return list(pairwise(edges))


def _differences(
    policy: Policy, plant: Plant, found: Floats, inputs: Mapping[str, Floats]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Differences of actions ``[B, A]`` as shares, 0 where they are ties, and which are ties."""
    given = {name: torch.from_numpy(value)[None] for name, value in inputs.items()}
    histories, proximity = given["history"], given.get("proximity")
    chosen = policy.act(histories, proximity, given.get("noise"))
    low, high = plant.limits.T
    middle, reach = (low + high) / 2, (high - low) / 2
    expected = middle + reach * chosen[0].double().numpy()
    # one step of float32 at these values, which rounding to the plant's units may cost
    step = np.spacing(np.abs(plant.limits).max(axis=1).astype(np.float32)) if plant.bounds else 0
    off = np.maximum(np.abs(found - expected) - step, 0.0) / reach
    off[~np.isfinite(found)] = np.inf
    if not policy.card.candidates:
        return off, np.zeros(len(off), dtype=np.bool_)
    theirs = torch.from_numpy((found - middle) / reach).float()[None]
    best, value = (
        policy.values(histories, actions, proximity)[0].double() for actions in (chosen, theirs)
    )
    as_good = (best - value).abs() <= TOLERANCE * best.abs().clamp(min=1.0)
    tied = (off.max(axis=1) > TOLERANCE) & as_good.numpy()
    off[tied] = 0.0
    return off, tied
