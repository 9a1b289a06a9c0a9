"""How a trial of judged policies begins: with which of them, at which λ, and how far it goes.

It begins where judges expect a gain and the log still knows what happens. Of a policy with a dial
that is the smallest such λ, 0 among them; what leaves the log often is never named as a beginning.
"""

import math
from collections.abc import Callable, Sequence
from typing import Final

from components.reporting.judged import Choice, Gain, JudgedLog

__all__ = [
    "FAR",
    "SURE",
    "agreed",
    "expectations",
    "first_steps",
    "percent",
    "with_gain",
    "with_sign",
]

FAR: Final = 0.25
"""Share of steps outside of the support from which a warning is due, and no trial begins.

On the furnace of docs/worked_example.md promises came true at 0.12 and 0.58 and not at 0.46: there
is no sharp edge, and what is said is a warning, not a verdict.
"""
SURE: Final = 2.0
"""Errors that a gain is to exceed; less may be chance, as may a loss of less."""

_SHORTLY: Final = "for a short time and under supervision"
_NO_DIAL: Final = "it has no λ by which it could be turned down, it can only be switched off"


def with_sign(log: JudgedLog, value: float) -> str:
    """A difference of returns with as many decimals as the log's returns need."""
    if not math.isfinite(value):
        return "not finite"
    return f"{round(value, log.decimals) + 0.0:+,.{log.decimals}f}"


def with_gain(log: JudgedLog, gain: Gain) -> str:
    """A gain with its error."""
    return f"{with_sign(log, gain.value)} ± {gain.error:,.{log.decimals}f}"


def expectations(log: JudgedLog, choice: Choice) -> str:
    """What every judge expects of a choice."""
    return ", ".join(f"{name} {with_gain(log, gain)}" for name, gain in choice.gains.items())


def percent(share: float) -> str:
    """A share for sentences."""
    return f"{share:.0%}" if math.isfinite(share) else "An unknown share"


def agreed(choice: Choice) -> bool:
    """Whether all judges expect a gain."""
    return all(gain.value > 0.0 for gain in choice.gains.values())


def first_steps(log: JudgedLog, best: Choice) -> tuple[list[str], Choice | None]:
    """How to begin on the plant, and with which policy.

    Args:
        log: What was judged.
        best: What the judge would choose, better than the behaviour by its score.

    Returns:
        Sentences; None where no policy is to be tried.
    """
    if log.doubts:
        return [
            "Nothing yet: judges that do not know what the log itself has earned know no policy. "
            "Fit them longer (model.recurrent_ensemble.updates, judging.estimates.updates) or with "
            "more episodes, and judge again."
        ], None
    fixed = _fixed(log)
    if (start := _smallest(log, best, agreed)) is not None:
        return [*_begin(log, best, start), *_onwards(log, start)], start
    if fixed is best:
        return [f"Try {best.name} ({_told(log, best)}) {_SHORTLY}: {_NO_DIAL}."], best
    if (start := _smallest(log, best, _no_loss)) is not None:
        return [*_begin(log, best, start), *_onwards(log, start)], start
    if not agreed(best):
        return _not_agreed(log, best), None
    return _unfamiliar(log, best, fixed)


def _told(log: JudgedLog, choice: Choice) -> str:
    """What is to be known of a choice before it is tried."""
    outside = f"{percent(choice.outside)} of the steps outside of what the log has seen"
    return f"{expectations(log, choice)}, {outside}"


def _familiar(choice: Choice) -> bool:
    return choice.outside < FAR  # false where it is unknown


def _no_loss(choice: Choice) -> bool:
    """Whether no judge expects a loss that would not be chance."""
    return all(gain.value >= -SURE * gain.error for gain in choice.gains.values())


def _fixed(log: JudgedLog) -> Choice | None:
    """The best familiar policy without λ of which all judges expect a gain."""
    found = (c for c in log.choices if c.proximity is None and _familiar(c) and agreed(c))
    return next(found, None)


def _dial(log: JudgedLog, algorithm: str) -> list[Choice]:
    """The choices of an algorithm up to the λ of its best score, the smallest λ first."""
    own = [c for c in log.choices if c.algorithm == algorithm and c.proximity is not None]
    highest = next((c for c in own if math.isfinite(c.score)), None)  # they come best first
    if highest is None:
        return []
    below = [c for c in own if (c.proximity or 0.0) <= (highest.proximity or 0.0)]
    return sorted(below, key=lambda choice: choice.proximity or 0.0)


def _smallest(log: JudgedLog, best: Choice, suits: Callable[[Choice], bool]) -> Choice | None:
    """The smallest familiar λ that suits, of the chosen algorithm or else of the next best.

    Where a fixed policy scores best, one with a dial is still the better beginning.
    """
    for algorithm in dict.fromkeys([best.algorithm, *(c.algorithm for c in log.choices)]):
        for choice in _dial(log, algorithm):
            if _familiar(choice) and suits(choice):
                return choice
    return None


def _begin(log: JudgedLog, best: Choice, start: Choice) -> list[str]:
    """With which λ a trial begins, and why."""
    if agreed(start):
        suits, judges = agreed, "all judges expect" if len(start.gains) > 1 else "the judge expects"
        words = f"{judges} a gain"
    else:
        suits, words = _no_loss, "no judge expects a loss that is more than chance"
    own = _dial(log, start.algorithm)
    if next(filter(suits, own)) is not start:
        words += " and less than a quarter of the steps lie outside of what the log has seen"
    said = [
        f"Begin with {start.name}, the smallest judged λ at which {words} ({_told(log, start)})."
    ]
    if suits is _no_loss:
        said.append("Where all judges expect a gain, a quarter of the steps or more lie outside.")
    if start.algorithm == best.algorithm:
        return said
    if best.proximity is None:
        return [*said, f"{best.name} scores best, but has no λ by which it could be turned down."]
    lacks = f"no judged λ of {best.algorithm} is both promising and familiar"
    return [*said, f"{best.name} scores best, but {lacks}."]


def _onwards(log: JudgedLog, start: Choice) -> list[str]:
    """How far to go from there."""
    higher = [c for c in _dial(log, start.algorithm) if _at(c) > _at(start)]
    if not higher:
        said = [f"With {start.algorithm} the judge would go no further."]
    else:
        far = next((c for c in higher if not _familiar(c)), None)
        known = ""
        if far is not None:
            known = (
                f"at λ {_at(far):.2f} already {percent(far.outside)} of the steps lie outside of "
                "what the log has seen, where judges only extrapolate, and "
            )
        said = [
            "Then go up in steps, and only as long as the plant itself shows the gain; "
            f"{known}the judge would not go beyond λ {_at(higher[-1]):.2f}."
        ]
    return [*said, *_guessed(log)]


def _guessed(log: JudgedLog) -> Sequence[str]:
    """What the log's exploration alone lets one expect of λ, if it was measured."""
    if log.guess is None:
        return []
    low, high = log.guess
    return [
        f"How much the log explores lets one guess a λ of {low:.2f}"
        + (f" to {high:.2f}" if high > low else " and no more")
        + " at first (flows.rank_datasets)."
    ]


def _not_agreed(log: JudgedLog, best: Choice) -> list[str]:
    """That nothing is tried where judges contradict each other."""
    said = [
        f"Nothing yet: the judges do not agree that {best.name} is a gain ({_told(log, best)})."
    ]
    if best.proximity is not None:
        said.append(
            f"If {best.algorithm} at all, then from λ 0, which does what was always done, up in "
            "small steps."
        )
    return said


def _unfamiliar(
    log: JudgedLog, best: Choice, fixed: Choice | None
) -> tuple[list[str], Choice | None]:
    """That what is promised lies outside of the log, and where to begin then."""
    own = _dial(log, best.algorithm)
    if best.proximity is None:
        said = [f"{best.name} is promising, but not familiar ({_told(log, best)})."]
    else:
        least = min((c.outside for c in own if agreed(c)), default=math.nan)
        said = [
            f"No judged λ of {best.algorithm} is both promising and familiar: where all judges "
            f"expect a gain, {percent(least).lower()} of the steps or more lie outside of what the "
            "log has seen."
        ]
    if fixed is not None:
        said.append(f"Try {fixed.name} ({_told(log, fixed)}) {_SHORTLY}: {_NO_DIAL}.")
        return said, fixed
    zero = next((c for c in own if _at(c) == 0.0), None)
    if zero is None or not _no_loss(zero):
        return [*said, "Begin with the logged behaviour: leave the plant as it is."], None
    said.append(
        f"Begin with the logged behaviour, or with {zero.name}, which is to imitate it "
        f"({_told(log, zero)}), {_SHORTLY}."
    )
    return [*said, *_onwards(log, zero)], zero


def _at(choice: Choice) -> float:
    return choice.proximity or 0.0
