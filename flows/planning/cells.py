"""The cells of a benchmark: a policy of every dataset, algorithm and seed."""

from components.reporting.thesis_numbers import thesis_numbers
from flows.configuration.settings import Settings
from flows.pipeline.plan import Plan

__all__ = ["cells_line"]


def cells_line(settings: Settings, plan: Plan) -> str:
    """How many cells a plan has, in a sentence.

    The algorithms of the thesis's tables 5.3 and 5.4 are counted by themselves: they are its
    benchmark, and LION, the clone and further ones stand beside them.

    Args:
        settings: What is wanted.
        plan: Made of it.
    """
    in_tables = {algorithm for _, algorithm in thesis_numbers()}
    policies = [node for node in plan if node.component == "policy_training"]
    cells = [node for node in policies if node.tags["algorithm"] in in_tables]
    kinds = {node.name.partition("/")[0] for node in cells}  # variants of an algorithm are several
    factors = len(settings.datasets), len(kinds), len(settings.seeds)
    others = [name for name in settings.algorithms if name not in in_tables]
    beside = f"{len(policies) - len(cells):,} of {', '.join(others)}" if others else ""
    if not cells:
        return f"{beside.replace(' of ', ' policies of ')}."
    product = " x ".join(map(str, factors))
    said = f"{product} = {len(cells):,} cells (datasets x algorithms x seeds)"
    return f"{said}{f', beside them {beside}' if beside else ''}."
