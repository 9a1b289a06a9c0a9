"""Prepared looks at the results of the benchmark, and at the runs behind them."""

from collections.abc import Sequence

from components.algorithms import ALGORITHMS
from flows.pipeline.plan import Node
from flows.pipeline.tracking.board import View

__all__ = ["benchmark_views"]

_TENTH, _GAIN = "return/tenth_percentile", "gain_over_behaviour"
_NUMBERS = (_TENTH, "return/mean", _GAIN, "proximity/best", "return/best", "distance")
_WHO = ("params.dataset", "params.algorithm", "params.seed")
_COLUMNS = (*_WHO, *(f"metrics.{name}" for name in _NUMBERS))
_BARS = (_TENTH, _GAIN, "return/mean", "distance")
_CURVES = tuple(f"over_proximity/{name}" for name in ("tenth_percentile", "mean", "distance"))
_NODE = ("tags.dataset", "tags.algorithm", "tags.seed", "tags.sweep", "metrics.usage/seconds")


def benchmark_views(tables: Sequence[Node]) -> list[View]:
    """Views for every dataset and algorithm, for results over the proximity, and of the ledger.

    Args:
        tables: The aggregation nodes of a plan.
    """
    datasets = dict.fromkeys(str(node.config["dataset"]) for node in tables)
    labels = dict.fromkeys(str(node.config["algorithm"]) for node in tables)
    adapt = [node for node in tables if ALGORITHMS[node.tags["algorithm"]].takes_proximity]
    return [
        View("results", "All results", columns=_COLUMNS, bars=_BARS),
        *(_on_dataset(dataset) for dataset in datasets),
        *(_of_algorithm(label) for label in labels),
        *([_over_proximity()] if adapt else []),
        *_ledger(),
    ]


def _on_dataset(dataset: str) -> View:
    return View(
        f"dataset-{dataset}",
        f"All algorithms on {dataset}",
        where=f"params.dataset = '{dataset}'",
        columns=_COLUMNS,
        order=f"metrics.{_TENTH}",
        descending=True,
        bars=_BARS,
        groups=("algorithm",),
    )


def _of_algorithm(label: str) -> View:
    return View(
        f"algorithm-{label}",
        f"{label} over the datasets",
        where=f"params.algorithm = '{label}'",
        columns=_COLUMNS,
        order=f"metrics.{_GAIN}",
        descending=True,
        bars=(_GAIN, _TENTH, "return/behaviour", "distance"),
        groups=("dataset",),
    )


def _over_proximity() -> View:
    return View(
        "proximity",
        "Results over the proximity (step: 100 λ)",
        where="tags.takes_proximity = 'yes'",
        columns=(*_COLUMNS, "metrics.proximity/return_at_0", "metrics.proximity/return_at_1"),
        lines=_CURVES,
        groups=("dataset", "algorithm"),
    )


def _ledger() -> list[View]:
    """One kind of runs each, side by side instead of below their sweeps."""
    sweep = ("tags.profile", "params.datasets", "params.algorithms", "params.seeds")
    numbers = ("metrics.transitions", "metrics.episodes")
    learned = ("validation_loss",)
    kinds = [
        View("sweeps", "Sweeps", "tags.role = 'sweep'", sweep),
        View("data", "Data sets", _component("data_generation"), (_NODE[0], *numbers)),
        View(
            "models",
            "Models",
            _component("model_fitting"),
            ("tags.model", *_NODE, "metrics.validation_loss"),
            bars=learned,
        ),
        View("policies", "Policies", _component("policy_training"), _NODE),
        View(
            "evaluations",
            "Evaluations",
            _component("evaluation"),
            _NODE,
            lines=("evaluation/return", "over_proximity/return"),
        ),
    ]
    return [View(**{**vars(view), "board": False}) for view in kinds]


def _component(name: str) -> str:
    return f"tags.component = '{name}'"
