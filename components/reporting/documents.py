"""The report as Markdown and as LaTeX: its tables and sentences, without figures."""

from components.reporting.agreement import agreement_table, correlation_rows
from components.reporting.evidence import Evidence
from components.reporting.overview_text import latex_overview, markdown_overview
from components.reporting.ranking import markdown
from components.reporting.verdicts import verdicts

__all__ = ["latex_document", "markdown_document"]


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
    if correlations := correlation_rows(agreement_table(evidence)):
        rows = "".join(
            f"| {r['domain']} | {r['cells']} | {r['spearman']:.2f} | {r['apart']} |\n"
            for r in correlations
        )
        head = "| on | cells | Spearman with the thesis | apart |\n| --- | --: | --: | --: |\n"
        parts.append(f"## Agreement with the thesis\n\n{head}{rows}")
    if not evidence.costs.empty:
        digits = {"runs": 0, "hours": 2, "minutes a run": 2, "memory (GiB)": 2}
        parts.append("## What it cost\n\n" + markdown(evidence.costs, digits))
    if evidence.gaps:
        gaps = "".join(f"- {gap.algorithm} on {gap.dataset}: {gap.why}\n" for gap in evidence.gaps)
        parts.append(f"## Missing\n\n{gaps}")
    commands = "".join(f"    {command}\n" for command in evidence.sweeps.values())
    parts.append(f"## How to repeat it\n\n{commands}")
    return "\n".join(parts)


def latex_document(evidence: Evidence) -> str:
    """The table of results for a LaTeX document (`booktabs`), with its notes as comments."""
    notes = "".join(f"% {note}\n" for note in (*evidence.table.notes(), *evidence.notes))
    commands = "".join(f"% {command}\n" for command in evidence.sweeps.values())
    return commands + notes + latex_overview(evidence.table)
