"""Trajectories of one policy at several proximities, beside each other."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

__all__ = ["trajectory_figure"]


def trajectory_figure(
    trajectories: Mapping[str, pd.DataFrame], features: Sequence[str], discount: float
) -> Figure:
    """Draw the reward and all features that change over the steps.

    Args:
        trajectories: By proximity, as text; columns are the features and ``reward``.
        features: Names of the values of a frame.
        discount: Gamma of the returns in the legend.
    """
    everything = pd.concat(trajectories.values())
    varying = [name for name in features if everything[name].nunique() > 1]
    names = ["reward", *varying]
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(3.4 * columns, 2.1 * rows + 0.4), layout="constrained")
    places = np.atleast_1d(figure.subplots(rows, columns, sharex=True)).ravel()
    for axes, name in zip(places, names, strict=False):
        for proximity, table in trajectories.items():
            axes.plot(range(1, len(table) + 1), table[name], linewidth=1.4, label=proximity)
        axes.set_title(name, fontsize="medium")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25, linewidth=0.5)
    for axes in places[len(names) :]:
        axes.set_visible(False)
    labels = [
        f"λ = {proximity}, return {_return(table, discount):.1f}"
        for proximity, table in trajectories.items()
    ]
    handles = places[0].get_lines()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    return figure


def _return(table: pd.DataFrame, discount: float) -> float:
    return float((table["reward"] * discount ** np.arange(len(table))).sum())
