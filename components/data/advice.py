"""What limits a log, in one sentence, and which proximities to try first.

Both are heuristics for somebody who has a log and no simulator. Their thresholds are round numbers
chosen by the look of the sixteen datasets of the benchmark, and nothing is derived from them.
"""

from typing import Final

from components.data.indicators import LogFacts

__all__ = ["initial_proximities", "limitation"]

FEW_WINDOWS: Final = 10
"""Fewer returns than these tell neither a mean nor a best episode."""
SMALL_IMPROVEMENT: Final = 0.01
"""ERI below which returns hardly vary."""
NARROW_ACTION: Final = 0.05
"""Share of its bounds below which an action hardly varies."""
FIXED_ACTIONS: Final = 0.1
"""EAS below which actions are a function of the state, as without exploration."""
LITTLE_EXPLORATION: Final = 0.5
"""EAS below which there is little exploration; a fifth of random actions makes 0.4 to 0.6."""
PROXIMITY_PER_EAS: Final = 0.5
"""Upper end of the first guess of the proximity over EAS, with the clip of 0.9."""
_STEP: Final = 0.05  # of the guess; the grid on which policies are evaluated


def limitation(facts: LogFacts, eri: float, eas: float) -> str:
    """One sentence about everything that limits a log, the worst first.

    Args:
        facts: What it shows.
        eri: Its expected return improvement.
        eas: Its expected action stochasticity.
    """
    found = [*_of_episodes(facts), *_of_returns(facts, eri), *_of_actions(facts, eas)]
    if not found:
        return "Nothing that these indicators see limits it."
    return f"Limited by {'; and by '.join(found)}."


def _of_episodes(facts: LogFacts) -> list[str]:
    if facts.windows >= FEW_WINDOWS:
        return []
    episodes = "a single episode" if facts.windows == 1 else f"{facts.windows} episodes only"
    means = "ERI is 0 by definition" if facts.windows == 1 else "ERI is largely chance"
    return [f"few episodes ({episodes} of {facts.window} steps or more, so that {means})"]


def _of_returns(facts: LogFacts, eri: float) -> list[str]:
    if facts.windows == 1 or eri >= SMALL_IMPROVEMENT:
        return []
    if facts.return_max == facts.return_min:
        return ["rewards that tell nothing (all episodes have the same return)"]
    return [
        f"a return that hardly varies (the best episode is {100 * eri:.1f} % above the mean, so "
        "that copying good episodes gains little)"
    ]


def _of_actions(facts: LogFacts, eas: float) -> list[str]:
    found = []
    named = zip(facts.actions, facts.action_range, strict=True)
    narrow = [name for name, share in named if share < NARROW_ACTION]
    if narrow:
        every = "every action" if len(narrow) == len(facts.actions) else ", ".join(narrow)
        found.append(
            f"narrow actions ({every} uses less than {100 * NARROW_ACTION:.0f} % of the bounds in "
            "nine steps of ten)"
        )
    if eas < FIXED_ACTIONS:
        found.append("no exploration (the state fixes the action, so that no other one was tried)")
    elif eas < LITTLE_EXPLORATION:
        found.append(f"little exploration (EAS is {eas:.2f})")
    return found


def initial_proximities(eas: float) -> tuple[float, float]:
    """A first guess of the proximities that are safe to try, from EAS alone (thesis 7.2).

    The thesis only expects that a log of little exploration wants a small λ. Here the range begins
    at 0, the clone, and ends at half of EAS, rounded down to the grid of the benchmark. What that
    would have been worth on the sixteen datasets stands in docs/ranking.md. It is no bound.
    """
    highest = min(1.0, PROXIMITY_PER_EAS * eas)
    return 0.0, round(_STEP * int(highest / _STEP + 1e-9), 2)
