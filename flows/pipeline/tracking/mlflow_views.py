"""Prepared looks at MLflow's runs: tags of an experiment that its page reads as saved views.

The page keeps what it shows (filter, order, columns, groups, charts) as JSON in such a tag when
somebody shares it, and opens it again from the tag's name in the address.
"""

import base64
import json
import time
import zlib
from collections.abc import Iterable, Mapping
from typing import Any
from urllib.parse import quote

from flows.pipeline.tracking.board import View

__all__ = ["saved_views", "view_query", "view_tags"]

_PREFIX = "mlflow.sharedViewState."


def view_tags(views: Iterable[View], known: Mapping[str, str]) -> dict[str, str]:
    """The tags of an experiment that its views need and that it does not have yet.

    Args:
        views: The wanted ones.
        known: The experiment's tags.
    """
    now = int(1000 * time.time())
    tags = {}
    for view in views:
        name, state = f"{_PREFIX}{view.key}", _packed(_state(view))
        before = _envelope(known.get(name, ""))
        if (before.get("name"), before.get("state")) != (view.name, state):
            tags[name] = json.dumps(
                {
                    "name": view.name,
                    "createdAt": before.get("createdAt", now),
                    "updatedAt": now,
                    "state": state,
                }
            )
    return tags


def saved_views(tags: Mapping[str, str]) -> dict[str, str]:
    """Names of an experiment's views by key, also of those that people have saved.

    Args:
        tags: Of the experiment.
    """
    keys = sorted(tag.removeprefix(_PREFIX) for tag in tags if tag.startswith(_PREFIX))
    names = {key: _envelope(tags[f"{_PREFIX}{key}"]).get("name", "") for key in keys}
    return {key: str(name) for key, name in names.items() if name}


def view_query(key: str) -> str:
    """The end of the address of a view, with its charts beside the table.

    Args:
        key: Of the view.
    """
    return f"viewStateShareKey={quote(key)}&compareRunsMode=CHART"


def _envelope(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError:
        return {}  # shared by hand, without a name
    return found if isinstance(found, dict) else {}


def _packed(state: Mapping[str, Any]) -> str:
    """As the page packs it: an experiment's tag holds 5,000 characters."""
    text = json.dumps(state, separators=(",", ":")).encode()
    return "deflate;" + base64.b64encode(zlib.compress(text, 9)).decode()


def _state(view: View) -> dict[str, Any]:
    """What the page keeps of itself; what is left out has its default."""
    state: dict[str, Any] = {
        "searchFilter": view.where,
        # Any order but that by date shows runs flat, not below their parents.
        "orderByKey": _column(view.order),
        "orderByAsc": not view.descending,
        "selectedColumns": [_column(name) for name in view.columns],
        "runsHiddenMode": "SHOW_ALL",
    }
    if view.groups:
        keys = [{"mode": "param", "groupByData": name} for name in view.groups]
        state["groupBy"] = {"aggregateFunction": "average", "groupByKeys": keys}
    charts = [_chart("BAR", name) for name in view.bars]
    charts += [_chart("LINE", name) for name in view.lines]
    if charts:
        section = {"uuid": "charts", "name": "Charts", "display": True, "isReordered": True}
        state["compareRunSections"] = [section | {"deleted": False, "isGenerated": False}]
        state["compareRunCharts"] = charts
        state["isAccordionReordered"] = True
    return state


def _chart(kind: str, metric: str) -> dict[str, Any]:
    chart: dict[str, Any] = {
        "type": kind,
        "uuid": f"{kind}-{metric}",
        "metricKey": metric,
        "metricSectionId": "charts",
        "deleted": False,
        "isGenerated": False,
        "runsCountToCompare": 100,
    }
    if kind == "LINE":
        chart |= {
            "selectedMetricKeys": [metric],
            "xAxisKey": "step",
            "useGlobalXaxisKey": False,
            "useGlobalLineSmoothing": True,
            "lineSmoothness": 0,
            "scaleType": "linear",
            "xAxisScaleType": "linear",
            "yAxisKey": "metric",
            "yAxisExpressions": [],
            "range": {},
        }
    return chart


def _column(name: str) -> str:
    """`params.seed` as the page names it: with the name in backquotes."""
    group, _, rest = name.partition(".")
    return name if rest.startswith("`") else f"{group}.`{rest}`"
