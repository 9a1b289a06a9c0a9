"""The cells of a benchmark: a policy of every dataset, algorithm and seed."""

from collections.abc import Sequence

from components.reporting.thesis_numbers import thesis_numbers
from flows.configuration.settings import Settings
from flows.pipeline.plan import Node, Plan

__all__ = ["cells_line"]


def cells_line(settings: Settings, plan: Plan) -> str:
    """How many cells a plan has, in a sentence; ``flows.status`` counts the same ones.

    Where the thesis's tables 5.3 and 5.4 hold some of them, these are counted by themselves, too:
    they are its benchmark, and LION, the clone and further ones stand beside them.

    Args:
        settings: What is wanted.
        plan: Made of it.
    """
    in_tables = thesis_numbers().keys()
    cells = [node for node in plan if node.component == "policy_training"]
    thesis = [n for n in cells if (n.tags["dataset"], n.tags["algorithm"]) in in_tables]
    many = "cell" if len(cells) == 1 else "cells"
    said = f"{_product(cells)} {many} (datasets x algorithms x seeds)"
    if not thesis or len(thesis) == len(cells):
        return f"{said}."
    same = {node.tags["algorithm"] for node in thesis}
    others = [name for name in settings.algorithms if name not in same]
    rest = f"{len(cells) - len(thesis):,}"
    beside = f"{rest} of {', '.join(others)}" if _datasets(thesis) == _datasets(cells) else rest
    return f"{said}: the thesis's {_product(thesis)}, and beside them {beside}."


def _datasets(cells: Sequence[Node]) -> set[str]:
    return {node.tags["dataset"] for node in cells}


def _product(cells: Sequence[Node]) -> str:
    """Datasets x algorithms x seeds = cells; variants of an algorithm are several."""
    kinds = {node.name.partition("/")[0] for node in cells}
    seeds = {node.tags["seed"] for node in cells}
    factors = " x ".join(str(len(part)) for part in (_datasets(cells), kinds, seeds))
    return f"{factors} = {len(cells):,}"
