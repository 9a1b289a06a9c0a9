"""What judges promise of a log's policies, in plain words: is a trial worth it, how to begin?"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import pandas as pd

from components.reporting.judged import Choice, Gain, JudgedLog

__all__ = ["FAR", "Promise", "promise", "with_sign"]

FAR: Final = 0.25
"""Share of steps outside of the support from which a warning is due.

On the furnace of docs/worked_example.md promises came true at 0.12 and 0.58 and not at 0.46: there
is no sharp edge, and what is said is a warning, not a verdict.
"""
_SURE: Final = 2.0  # errors that a gain is to exceed
_FEW: Final = 4  # choices of which an order says little
_MUCH_MORE: Final = 1.5  # times the chosen gain, from which a higher promise is worth a word

Judgement = Literal["gain", "unsure", "none", "unknown"]


@dataclass(frozen=True)
class Promise:
    """What to make of a judged log.

    Attributes:
        log: Its label.
        judgement: In one word.
        headline: In a few words.
        sentences: What the judge would choose, and what it expects.
        warnings: Why not to believe it.
        first: What to try first.
        run: Of the policy to try first; empty if none is.
    """

    log: str
    judgement: Judgement
    headline: str
    sentences: Sequence[str]
    warnings: Sequence[str] = ()
    first: Sequence[str] = ()
    run: str = ""


def promise(log: JudgedLog) -> Promise:
    """The plain words on one log."""
    best = log.best
    if not log.choices:
        return Promise(log.name, "unknown", "Not judged yet", list(log.progress))
    if best is None:
        said = ["No estimate of any policy is finite: their training has diverged."]
        return Promise(log.name, "unknown", "No judgement", [*said, *log.progress])
    warnings = [*log.doubts, *_contradictions(log, best), *_outside(best)]
    if best.score <= 0.0:
        said = [
            "No judged policy is expected to be better than the behaviour in the log, once steps "
            f"outside of the log are charged for. The best is {best.name}: "
            f"{_expectations(log, best)}."
        ]
        first = ["Nothing: leave the plant as it is. A log with more variety may hold more."]
        headline = "Leave it as it is"
        return Promise(log.name, "none", headline, [*said, *log.progress], log.doubts, first)
    judgement, headline = _judge(log, best)
    first, run = _first(log, best)
    return Promise(
        log.name,
        judgement,
        headline,
        [*_chosen(log, best), *log.progress],
        [*warnings, *_higher(log, best)],
        first,
        run,
    )


def with_sign(log: JudgedLog, value: float) -> str:
    """A difference of returns with as many decimals as the log's returns need."""
    if not math.isfinite(value):
        return "not finite"
    return f"{round(value, log.decimals) + 0.0:+,.{log.decimals}f}"


def _gain(log: JudgedLog, gain: Gain) -> str:
    return f"{with_sign(log, gain.value)} ± {gain.error:,.{log.decimals}f}"


def _expectations(log: JudgedLog, choice: Choice) -> str:
    return ", ".join(f"{name} {_gain(log, gain)}" for name, gain in choice.gains.items())


def _judge(log: JudgedLog, best: Choice) -> tuple[Judgement, str]:
    if log.doubts:
        return "unsure", "The judges do not know this plant"
    if _opposed(best):
        return "unsure", "The judges contradict each other"
    if best.outside >= FAR:
        return "unsure", "A promise from outside of the log"
    if any(gain.value < _SURE * gain.error for gain in best.gains.values()):
        return "unsure", "A gain that may be chance"
    return "gain", "Worth a careful trial"


def _chosen(log: JudgedLog, best: Choice) -> list[str]:
    """What would be chosen, and by how much it is expected to be better."""
    share, mean, expected = "", "", best.expected
    if log.returns is not None and log.returns.mean:
        part = expected.value / abs(log.returns.mean)
        share = f", {part:.0%} of the {_plain(log, log.returns.mean)} in the log"
    if best.policies > 1:
        mean = f", in the mean of its {best.policies} policies"
    said = [
        f"From the log alone the judge would choose {best.name}. It is expected to return "
        f"{_plain(log, expected.value)} ± {_plain(log, expected.error)} more than the logged "
        f"behaviour{share}{mean}."
    ]
    if best.model is None:
        said.append("No ensemble was fitted to this log: fitted critics judge alone.")
    else:
        said.append(f"That is by the ensemble; fitted critics expect {_gain(log, best.critics)}.")
    if best.sceptical is not None:
        value = with_sign(log, best.sceptical)
        said.append(f"By the ensemble's least favourable member for either it is {value}.")
    if best.policies == 1:
        said.append("It was trained once: with another seed it may come out otherwise.")
    if best.outside < FAR:
        said.append(
            f"{_percent(best.outside)} of its steps lie outside of what the log has seen "
            f"({_percent(best.usually_outside)} of the behaviour's own)."
        )
    return said


def _contradictions(log: JudgedLog, best: Choice) -> list[str]:
    """Where the ensemble and the critics do not say the same, of the choice and over all."""
    said = []
    if best.model is not None:
        apart = abs(best.model.value - best.critics.value)
        both = _expectations(log, best)
        if _opposed(best):
            said.append(f"The judges contradict each other on {best.name}: {both}.")
        elif apart > _SURE * math.hypot(best.model.error, best.critics.error):
            said.append(f"The judges differ on {best.name} by more than their errors: {both}.")
    pairs = [(c.model.value, c.critics.value) for c in log.choices if c.model is not None]
    if len(pairs) >= _FEW:
        table = pd.DataFrame(pairs).replace([math.inf, -math.inf], math.nan)
        correlation = float(table[0].corr(table[1], method="spearman"))
        if correlation < 0.0:
            said.append(
                "What the ensemble finds better, the critics find worse: over all choices their "
                f"orders are opposed (Spearman's correlation {correlation:.2f})."
            )
    return said


def _opposed(choice: Choice) -> bool:
    """Whether one judge expects a gain and the other a loss."""
    return len({gain.value > 0.0 for gain in choice.gains.values()}) > 1


def _outside(best: Choice) -> list[str]:
    if best.outside < FAR:
        return []
    return [
        f"{_percent(best.outside)} of the steps of {best.name} lie outside of what the log has "
        "seen. Nobody has been there: judges only extrapolate, and may all be wrong together."
    ]


def _higher(log: JudgedLog, best: Choice) -> list[str]:
    """The highest promise, where it is much higher than the choice's and far outside."""
    known = [c for c in log.choices if math.isfinite(c.expected.value)]
    highest = max(known, key=lambda c: c.expected.value, default=best)
    if (
        highest is best
        or highest.outside < FAR
        or highest.expected.value < _MUCH_MORE * best.expected.value
    ):
        return []
    value = with_sign(log, highest.expected.value)
    return [
        f"Do not be tempted by {highest.name}: {value} is promised, "
        f"but {_percent(highest.outside)} of its steps lie outside of what the log has seen."
    ]


def _start(log: JudgedLog, best: Choice) -> Choice:
    """The smallest λ of the chosen algorithm at which all judges expect a gain, if it takes one.

    Of an algorithm with a dial, that is where a careful trial begins. Where a fixed policy scores
    best, a policy with a dial of which all judges expect a gain still is the better beginning.
    """
    hopeful = [c for c in log.choices if c.proximity and c.score > 0.0 and _agreed(c)]
    dials = [c.algorithm for c in hopeful]
    dial = best.algorithm if best.proximity is not None else next(iter(dials), "")
    highest = math.inf if best.proximity is None else best.proximity
    own = [c for c in hopeful if c.algorithm == dial and (c.proximity or 0.0) <= highest]
    return min(own, key=lambda choice: choice.proximity or 0.0, default=best)


def _agreed(choice: Choice) -> bool:
    """Whether all judges expect a gain."""
    return all(gain.value > 0.0 for gain in choice.gains.values())


def _first(log: JudgedLog, best: Choice) -> tuple[list[str], str]:
    """How to begin on the plant, and the run of the policy to begin with; empty for none."""
    if log.doubts:
        return [
            "Nothing yet: judges that do not know what the log itself has earned know no policy. "
            "Fit them longer (model.recurrent_ensemble.updates, judging.estimates.updates) or with "
            "more episodes, and judge again."
        ], ""
    start = _start(log, best)
    outside = f"{_percent(start.outside)} of the steps outside of what the log has seen"
    expected = f"{_expectations(log, start)}, {outside}"
    if not _agreed(start):
        said = [f"Nothing yet: the judges do not agree that {start.name} is a gain ({expected})."]
        if start.proximity is not None:
            said.append(
                f"If {start.algorithm} at all, then from λ 0, which does what was always done, up "
                "in small steps."
            )
        return said, ""
    if start.proximity is None:
        return [
            f"Try {start.name} ({expected}) for a short time and under supervision: it has no λ "
            "by which it could be turned down, it can only be switched off."
        ], start.run
    all_judges = "all judges expect" if len(start.gains) > 1 else "the judge expects"
    said = [
        f"Begin with {start.name}, the smallest judged λ at which {all_judges} a gain ({expected})."
    ]
    if best.proximity is None:
        said.append(f"{best.name} scores best, but has no λ by which it could be turned down.")
    limit = next(c for c in log.choices if c.algorithm == start.algorithm)  # of its best score
    if (limit.proximity or 0.0) > start.proximity:
        said.append(
            "Then go up in steps, and only as long as the plant itself shows the gain; the judge "
            f"would not go beyond λ {limit.proximity:.2f}."
        )
    else:
        said.append(f"With {start.algorithm} the judge would go no further.")
    return said, start.run


def _percent(share: float) -> str:
    return f"{share:.0%}" if math.isfinite(share) else "An unknown share"


def _plain(log: JudgedLog, value: float) -> str:
    return f"{value:,.{log.decimals}f}"
