"""The plan of a ranking: the indicators of every chosen dataset, and the datasets themselves."""

from dataclasses import asdict

from flows.configuration.settings import Settings
from flows.pipeline.plan import Node, Plan
from flows.planning.nodes import data_node, jsonable

__all__ = ["indicator_node", "ranking_plan"]

VERSION = 1
"""Of the code that measures indicators; raise it when their results change."""


def indicator_node(settings: Settings, dataset: str) -> Node:
    """The node that measures the indicators of a dataset.

    The floor of returns is not part of it: it is applied to what was measured, so that another one
    needs no new fit.

    Raises:
        SettingsError: What the dataset is made with is missing or damaged.
    """
    config = settings.ranking.stochasticity
    return Node(
        component="indicators",
        name=f"indicators/{dataset}",
        task="flows.tasks.ranking:measure_indicators",
        version=VERSION,
        config={"stochasticity": jsonable(asdict(config))},
        inputs={"dataset": data_node(settings, dataset)},
        tags={"dataset": dataset},
        cost=1.0 + 6e-4 * len(config.lanes) * config.updates,
    )


def ranking_plan(settings: Settings) -> Plan:
    """Indicators of all chosen datasets.

    Raises:
        SettingsError: What a dataset is made with is missing or damaged.
    """
    return Plan([indicator_node(settings, name) for name in settings.datasets])
