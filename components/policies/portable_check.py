"""Whether a file acts as the policy that it was made from, on recorded states.

The original and the file compute the same sums of float32 numbers in another order, so their
actions differ in the last digits: by some 1e-7 of half an action's range where networks are smooth.
A file may differ by `TOLERANCE`. Sharp policies, whose networks saturate, magnify the last digits:
the original itself acts otherwise alone than among others. So a file may also differ by
`ROUNDINGS` times what the original differs from itself in double precision, but never by more than
`LIMIT`. An action in the units of a plant is moreover rounded to float32 there.

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

__all__ = ["PROXIMITIES", "ROUNDINGS", "TOLERANCE", "Checked", "States", "compare", "drawn_states"]

TOLERANCE: Final = 1e-5
"""Difference of an action that is always allowed, as a share of half its range."""
ROUNDINGS: Final = 10.0
LIMIT: Final = 1e-2
"""What is never exceeded, however sharp a policy is."""
PROXIMITIES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
_BATCH: Final = 100  # candidates of more states at once take too much memory
_DRAWN: Final = 1000

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]


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
        allowed: The largest that would have passed.
        ties: Actions that are another candidate, as good to the critic.
    """

    states: int
    actions: int
    difference: float
    allowed: float
    ties: int

    def __str__(self) -> str:
        ties = f", {self.ties} ties between candidates" if self.ties else ""
        return (
            f"{self.actions} actions in {self.states} states differ by at most "
            f"{self.difference:.1e} of half their range (allowed {self.allowed:.1e}){ties}"
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
    exact = Policy.of_tensors(policy.card, {n: t.double() for n, t in policy.tensors().items()})
    worst, own, ties = 0.0, 0.0, 0
    for first, last in _batches(len(seen)):
        inputs: dict[str, Any] = {"history": seen[first:last], "proximity": proximity[first:last]}
        shapes = input_shapes(policy.card)
        if "noise" in shapes:
            inputs["noise"] = noise.standard_normal((last - first, *shapes["noise"]), np.float32)
        inputs = {name: inputs[name] for name in shapes}
        expected = _acted(policy, plant, inputs)
        off, tied = _differences(policy, plant, inputs, run(inputs), expected)
        rounding, _ = _differences(policy, plant, inputs, _acted(exact, plant, inputs), expected)
        ties += int(tied.sum())
        worst, own = max(worst, off.max()), max(own, rounding.max())
    allowed = min(max(TOLERANCE, ROUNDINGS * own), LIMIT)
    if worst > allowed:
        raise ValueError(
            f"differs from the policy by {worst:.1e} of half an action's range, and {allowed:.1e} "
            "is allowed"
        )
    return Checked(len(histories), len(seen), float(worst), float(allowed), ties)


def _batches(number: int) -> list[tuple[int, int]]:
    edges = [0, *range(1, number, _BATCH), number]
    return list(pairwise(edges))


def _acted(policy: Policy, plant: Plant, inputs: Mapping[str, Floats]) -> Doubles:
    """What a policy does, ``[B, A]`` in the units of the plant, in its own precision until then."""
    kind = policy.frames.mean.dtype
    given = {name: torch.from_numpy(value)[None].to(kind) for name, value in inputs.items()}
    chosen = policy.act(given["history"], given.get("proximity"), given.get("noise"))
    middle, reach = _ranges(plant)
    acted: Doubles = middle + reach * chosen[0].double().numpy()
    return acted


def _ranges(plant: Plant) -> tuple[Doubles, Doubles]:
    """Middle and half the range of each action."""
    low, high = plant.limits.T
    return (low + high) / 2, (high - low) / 2


def _differences(
    policy: Policy,
    plant: Plant,
    inputs: Mapping[str, Floats],
    found: npt.NDArray[np.floating],
    expected: Doubles,
) -> tuple[Doubles, npt.NDArray[np.bool_]]:
    """Differences of actions ``[B, A]`` as shares, 0 where they are ties, and which are ties."""
    middle, reach = _ranges(plant)
    # one step of float32 at these values, which rounding to the plant's units may cost
    step = np.spacing(np.abs(plant.limits).max(axis=1).astype(np.float32)) if plant.bounds else 0
    off = np.maximum(np.abs(found - expected) - step, 0.0) / reach
    off[~np.isfinite(found)] = np.inf
    if not policy.card.candidates:
        return off, np.zeros(len(off), dtype=np.bool_)
    given = {name: torch.from_numpy(value)[None] for name, value in inputs.items()}
    best, value = (
        policy.values(
            given["history"],
            torch.from_numpy((actions - middle) / reach).float()[None],
            given.get("proximity"),
        )[0].double()
        for actions in (expected, found)
    )
    as_good = (best - value).abs() <= TOLERANCE * best.abs().clamp(min=1.0)
    tied = (off.max(axis=1) > TOLERANCE) & as_good.numpy()
    off[tied] = 0.0
    return off, tied
