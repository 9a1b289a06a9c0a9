"""Panels of several datasets: what is drawn, and where."""

import math
from pathlib import Path

import numpy as np
import pytest

from components.reporting.figures import save_figure
from components.reporting.panels import Line, Panel, panels_figure

X = np.array([0.0, 0.5, 1.0])


def line(name: str, mean: list[float], *, distance: bool = True, decisive: bool = True) -> Line:
    return Line(name, X, np.array(mean), np.full(3, 2.0), X if distance else None, decisive)


def test_a_panel_per_dataset_with_returns_above_and_distances_below(tmp_path: Path) -> None:
    panels = [
        Panel("bad-0.4", -90.0, [line("LION", [-90.0, -80.0, -70.0])], mark=(0.5, -80.0)),
        Panel("toy", math.nan, [line("RvS", [-9.0, -8.0, -7.0]), line("LION", [-9.0, -8.0, -6.0])]),
    ]
    figure = panels_figure(panels, "proximity λ")
    above, other, below, distances = figure.axes
    assert [axes.get_title() for axes in (above, other)] == ["bad-0.4", "toy"]
    assert above.get_lines()[0].get_ydata().tolist() == [-90.0, -80.0, -70.0]
    assert set(above.get_lines()[1].get_ydata()) == {-90.0}
    assert [float(v) for v in above.get_lines()[2].get_xdata()] == [0.5]
    assert below.get_lines()[0].get_ydata().tolist() == X.tolist()
    assert below.get_xlabel() == distances.get_xlabel() == "proximity λ"
    [legend] = figure.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["LION", "RvS", "logged behaviour"]
    colours = {name: line.get_color() for name, line in zip(names, legend.get_lines(), strict=True)}
    assert above.get_lines()[0].get_color() == colours["LION"]
    assert other.get_lines()[1].get_color() == colours["LION"], "one colour in all panels"
    save_figure(figure, tmp_path / "figure.png")


def test_what_is_not_decisive_may_leave_the_panel() -> None:
    shown = [line("kept", [-9.0, -8.0, -7.0]), line("far", [-9.0, -500.0, -900.0], decisive=False)]
    low, high = panels_figure([Panel("toy", -8.0, shown)], "updates").axes[0].get_ylim()
    assert -12.0 < low < -11.0, "the band of the first, and what is not far below it"
    assert -5.0 < high < -4.0


def test_axes_may_fall_and_be_logarithmic_with_a_zero() -> None:
    made = panels_figure([Panel("toy", 0.0, [line("errors", [1.0, 2.0, 3.0], distance=False)])],
                         "η", backwards=True, logarithmic=True)  # fmt: skip
    [axes] = made.axes
    first, last = axes.get_xlim()
    assert first > last
    assert axes.get_xscale() == "symlog"


@pytest.mark.parametrize(("panels", "columns"), [(1, 2), (4, 4)])
def test_a_legend_has_as_many_columns_as_fit(panels: int, columns: int) -> None:
    x = np.linspace(0.0, 1.0, 3)
    lines = [Line(f"Beta({value}, {value}), long", x, x) for value in ("0.1", "0.3", "1", "3")]
    figure = panels_figure([Panel("bad-0.2", 0.5, lines)] * panels, "λ")
    figure.draw_without_rendering()
    [legend] = figure.legends
    box = legend.get_window_extent()
    assert box.x0 >= 0.0
    assert box.x1 <= figure.bbox.width
    assert len({round(text.get_window_extent().x0) for text in legend.get_texts()}) == columns
