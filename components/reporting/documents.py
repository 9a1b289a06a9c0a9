"""The report as Markdown and as LaTeX: its tables and sentences, without figures."""

from collections.abc import Mapping, Sequence

import pandas as pd

from components.reporting.agreement import agreement_table, correlation_rows
from components.reporting.evidence import Evidence
from components.reporting.glossary import JUDGED_GLOSSARY
from components.reporting.judged import Judged, JudgedLog, choice_table, digits_of
from components.reporting.overview_text import latex_overview, markdown_overview
from components.reporting.promises import promise
from components.reporting.ranking import markdown
from components.reporting.verdicts import verdicts

__all__ = ["judged_document", "latex_document", "markdown_document"]


def markdown_document(evidence: Evidence) -> str:
    """The report as Markdown."""
    parts = [
        f"# {', '.join(evidence.sweeps)}\n\n{evidence.budget[0].upper()}{evidence.budget[1:]}.\n",
        "## Results\n\n" + markdown_overview(evidence.table),
        "".join(f"- {note}\n" for note in (*evidence.table.notes(), *evidence.notes)),
        "## In plain words\n\n"
        + "".join(
            f"- **{v.dataset}: {v.headline}.** {' '.join(v.sentences)}\n"
            for v in verdicts(evidence)
        ),
    ]
    if evidence.judged:
        parts += ["## Logs without a real system\n", *_of_logs(evidence.judged)]
    if correlations := correlation_rows(agreement_table(evidence)):
        rows = "".join(
            f"| {r['domain']} | {r['cells']} | {r['spearman']:.2f} | {r['apart']} |\n"
            for r in correlations
        )
        head = "| on | cells | Spearman with the thesis | apart |\n| --- | --: | --: | --: |\n"
        parts.append(f"## Agreement with the thesis\n\n{head}{rows}")
    parts += _costs(evidence.costs)
    if evidence.gaps:
        gaps = "".join(f"- {gap.algorithm} on {gap.dataset}: {gap.why}\n" for gap in evidence.gaps)
        parts.append(f"## Missing\n\n{gaps}")
    parts.append(_commands(evidence.sweeps))
    return "\n".join(parts)


def judged_document(judged: Judged) -> str:
    """A report on policies that were judged and never tried, as Markdown."""
    parts = [
        f"# Judged from the log: {', '.join(judged.sweeps)}\n\n"
        f"{judged.budget[0].upper()}{judged.budget[1:]}. Nothing here has been tried in reality: "
        "every number is a judgement from the log alone; ± is one standard error.\n",
        *_of_logs(judged.logs),
        "".join(f"- {note}\n" for note in judged.notes),
        *_costs(judged.costs),
        _commands(judged.sweeps),
        "## Glossary\n\n" + "".join(f"- **{word}**: {text}\n" for word, text in JUDGED_GLOSSARY),
    ]
    return "\n".join(part for part in parts if part)


def _of_logs(logs: Sequence[JudgedLog]) -> list[str]:
    """What was judged, log by log."""
    parts = []
    for log in logs:
        said = promise(log)
        first = [f"What to try first. {' '.join(said.first)}"] if said.first else []
        if said.run:
            first.append(
                f"Taking it along: `python -m flows.export_policy run={said.run} to=policy.onnx`"
            )
        careful = [f"Careful: {warning}" for warning in said.warnings]
        lines = [" ".join(said.sentences), *careful, *first]
        parts.append(
            f"## {log.name}: {said.headline}\n\n" + "".join(f"- {line}\n" for line in lines if line)
        )
        if not said.leads.empty:
            parts.append(
                "Where that leads: between which values nearly everything lies (98 %) that the "
                "ensemble expects, and all of the judges' part of the log.\n"
            )
            parts.append(markdown(said.leads, {}))
        parts.append("".join(f"- {name}: {text}\n" for name, text in log.facts.items()))
        if log.choices:
            table = choice_table(log)
            parts.append(markdown(table, {n: d for n, d in digits_of(log).items() if n in table}))
    return parts


def _costs(costs: pd.DataFrame) -> list[str]:
    if costs.empty:
        return []
    digits = {"runs": 0, "hours": 2, "minutes a run": 2, "memory (GiB)": 2}
    return ["## What it cost\n\n" + markdown(costs, digits)]


def _commands(sweeps: Mapping[str, str]) -> str:
    commands = "".join(f"    {command}\n" for command in sweeps.values())
    return f"## How to repeat it\n\n{commands}"


def latex_document(evidence: Evidence) -> str:
    """The table of results for a LaTeX document (`booktabs`), with its notes as comments."""
    notes = "".join(f"% {note}\n" for note in (*evidence.table.notes(), *evidence.notes))
    commands = "".join(f"% {command}\n" for command in evidence.sweeps.values())
    return commands + notes + latex_overview(evidence.table)
