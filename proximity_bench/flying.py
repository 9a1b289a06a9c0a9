"""The autopilot on a policy: a safe search for the proximity, in any system."""

from collections.abc import Callable
from typing import Any

from components.data.returns import RETURN_STEPS, window_returns
from components.evaluation.autopilot import Autopilot, AutopilotConfig, Found, fly
from components.evaluation.guarantee import USUAL
from components.operating.flying import usual_size
from proximity_bench.operating import trajectory
from proximity_bench.policies import Policy

__all__ = ["autopilot"]


def autopilot(
    policy: Policy,
    make: Callable[[float], float] | None = None,
    *,
    budget: int = 50,
    margin: float | None = None,
    slope: float | None = None,
    seed: int = 0,
    **settings: Any,
) -> Found:
    """Search the best proximity, trajectory by trajectory, without going below a margin.

    Args:
        policy: One that takes a proximity.
        make: Makes a trajectory at a proximity and returns its discounted return; None: in the real
            system that the card of the policy's log names.
        budget: Trajectories in all.
        margin: By how much the mean return may be below that of proximity 0; None: a tenth of the
            size of the log's mean return.
        slope: By how much the mean return may fall per unit of proximity; None: four times that
            size. The guarantee is worth as much as this number.
        seed: Of the first trajectory in the real system; the others have the next ones.
        settings: Further ones of :class:`AutopilotConfig`, e.g. ``risk=0.05, reference=-75.0``.

    Returns:
        What was found, and all that was tried.

    Raises:
        ValueError: The policy takes no proximity, has no system or no log, or a setting is out of
            range.
    """
    if not policy.takes_proximity:
        raise ValueError(f"A policy of {policy.algorithm} takes no proximity to be searched.")
    if margin is None or slope is None:
        if policy.log is None:
            raise ValueError(
                f"{policy!r} does not know its log, whose returns would tell what much is; give "
                "margin and slope, in units of return."
            )
        size = usual_size(policy.log)
        margin = USUAL.margin * size if margin is None else margin
        slope = USUAL.slope * size if slope is None else slope
    try:
        config = AutopilotConfig(budget=budget, margin=margin, slope=slope, **settings)
    except TypeError as error:
        raise ValueError(f"The autopilot knows no such setting ({error}).") from error
    pilot = Autopilot(config)

    def real(proximity: float) -> float:
        found = trajectory(policy, proximity, steps=RETURN_STEPS, seed=seed + pilot.used)
        discount = 1.0 if policy.log is None else policy.log.discount
        return float(window_returns(found["reward"].to_numpy(), discount, len(found))[0])

    return fly(pilot, make or real)
