"""What judges promise of a log's policies, in plain words: is a trial worth it, how to begin?"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import pandas as pd

from components.reporting.judged import Choice, JudgedLog
from components.reporting.leads import lead_table, strays
from components.reporting.trial import (
    FAR,
    SURE,
    expectations,
    first_steps,
    percent,
    with_gain,
    with_sign,
)

__all__ = ["Promise", "brief", "promise"]

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
        leads: Where it, and what would be chosen, lead the plant: empty where that is not known.
    """

    log: str
    judgement: Judgement
    headline: str
    sentences: Sequence[str]
    warnings: Sequence[str] = ()
    first: Sequence[str] = ()
    run: str = ""
    leads: pd.DataFrame = field(default_factory=pd.DataFrame)


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
            f"{expectations(log, best)}."
        ]
        first = ["Nothing: leave the plant as it is. A log with more variety may hold more."]
        headline = "Leave it as it is"
        return Promise(log.name, "none", headline, [*said, *log.progress], log.doubts, first)
    judgement, headline = _judge(log, best)
    first, start = first_steps(log, best)
    shown = list(dict.fromkeys(choice.name for choice in (start, best) if choice is not None))
    named = {choice.name: choice.leads for choice in log.choices if choice.name in shown}
    return Promise(
        log.name,
        judgement,
        headline,
        [*_chosen(log, best), *log.progress],
        [
            *warnings,
            *(said for name in shown for said in strays(name, named[name])),
            *_higher(log, best),
        ],
        first,
        start.run if start is not None else "",
        lead_table({name: named[name] for name in shown}),
    )


def brief(log: JudgedLog) -> list[str]:
    """What a terminal says of one log; what speaks against it is left to the page."""
    said = promise(log)
    lines = [f"{log.name}: {said.headline}. Judged from the log alone, never tried."]
    if said.first:
        lines.append(f"What to try first. {' '.join(said.first)}")
    if said.warnings:
        lines.append("The page says what speaks against it.")
    return lines


def _judge(log: JudgedLog, best: Choice) -> tuple[Judgement, str]:
    if log.doubts:
        return "unsure", "The judges do not know this plant"
    if _opposed(best):
        return "unsure", "The judges contradict each other"
    if best.outside >= FAR:
        return "unsure", "A promise from outside of the log"
    if any(gain.value < SURE * gain.error for gain in best.gains.values()):
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
        said.append(
            f"That is by the ensemble; fitted critics expect {with_gain(log, best.critics)}."
        )
    if best.sceptical is not None:
        value = with_sign(log, best.sceptical)
        said.append(f"By the ensemble's least favourable member for either it is {value}.")
    if best.policies == 1:
        said.append("It was trained once: with another seed it may come out otherwise.")
    if best.outside < FAR:
        said.append(
            f"{percent(best.outside)} of its steps lie outside of what the log has seen "
            f"({percent(best.usually_outside)} of the behaviour's own)."
        )
    return said


def _contradictions(log: JudgedLog, best: Choice) -> list[str]:
    """Where the ensemble and the critics do not say the same, of the choice and over all."""
    said = []
    if best.model is not None:
        apart = abs(best.model.value - best.critics.value)
        both = expectations(log, best)
        if _opposed(best):
            said.append(f"The judges contradict each other on {best.name}: {both}.")
        elif apart > SURE * math.hypot(best.model.error, best.critics.error):
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
        f"{percent(best.outside)} of the steps of {best.name} lie outside of what the log has "
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
        f"but {percent(highest.outside)} of its steps lie outside of what the log has seen."
    ]


def _plain(log: JudgedLog, value: float) -> str:
    return f"{value:,.{log.decimals}f}"
