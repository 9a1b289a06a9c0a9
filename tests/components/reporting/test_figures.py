"""The figure over the proximity parameter: what is drawn, and where."""

from pathlib import Path

import numpy as np
import pytest

from components.reporting.figures import proximity_figure, save_figure
from tests.components.reporting.summaries import LION, TD3_BC, point


def test_adaptive_policies_are_curves_and_the_others_dashed_lines(tmp_path: Path) -> None:
    figure = proximity_figure("mediocre-0.2", [TD3_BC, LION], -76.5)
    assert figure is not None
    upper, lower = figure.axes
    assert upper.get_title() == "mediocre-0.2"
    curve, dashed, dotted = upper.get_lines()
    assert curve.get_xdata().tolist() == [0.0, 0.5, 1.0]
    assert curve.get_ydata().tolist() == [-90.0, -70.0, -80.0]
    assert (dashed.get_linestyle(), dotted.get_linestyle()) == ("--", ":")
    assert set(dashed.get_ydata()) == {-77.0}
    assert set(dotted.get_ydata()) == {-76.5}
    assert upper.get_legend() is None, "a legend would lie over lines"
    assert [text.get_text() for text in upper.texts] == [
        "lion -80",
        "td3_bc -77",
        "logged behaviour -76",
    ]
    assert all(text.xy[0] == 1.0 and text.xyann[0] > 0 for text in upper.texts), "right of the edge"
    assert "return" in upper.get_ylabel()
    assert "λ" in lower.get_xlabel()
    assert "distance" in lower.get_ylabel()
    assert lower.get_lines()[0].get_ydata().tolist() == [0.0, 0.25, 0.5]
    assert lower.get_xlim() == (0.0, 1.0)
    assert len({line.get_color() for line in upper.get_lines()}) == 3
    save_figure(figure, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_band_is_the_spread_of_seeds() -> None:
    figure = proximity_figure("toy", [LION], -76.5)
    assert figure is not None
    [band] = figure.axes[0].collections
    heights = band.get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (-92.0, -68.0)


def test_a_diverged_policy_does_not_squeeze_the_others() -> None:
    far = TD3_BC | {"algorithm": "ddpg", "points": [point(None) | {"mean": -960.0}]}
    figure = proximity_figure("toy", [LION, TD3_BC, far], -76.5)
    assert figure is not None
    upper = figure.axes[0]
    low, high = upper.get_ylim()
    assert -100.0 < low < -92.0  # the band's lower end, and a margin
    assert -68.0 < high < -60.0
    [name] = [text for text in upper.texts if text.get_text() == "ddpg -960 ↓"]
    assert name.xy == (1.0, 0.0), "at the edge beyond which it lies"


def test_names_are_apart_and_the_title_tells_profile_and_seeds() -> None:
    same = [TD3_BC | {"algorithm": f"twin{number}"} for number in range(12)]
    figure = proximity_figure("toy", [LION, *same], float("nan"), "profile quick, 5 seeds")
    assert figure is not None
    upper = figure.axes[0]
    heights = sorted(text.xy[1] for text in upper.texts)
    assert min(np.diff(heights)) > 0.05
    assert (min(heights), max(heights)) >= (0.0, 0.0)
    assert max(heights) <= 1.0
    assert upper.get_title() == "toy (profile quick, 5 seeds)"
    assert not [text for text in upper.texts if "logged" in text.get_text()]


def test_nothing_to_draw_without_adaptive_policies() -> None:
    assert proximity_figure("mediocre-0.2", [TD3_BC], -76.5) is None
    assert proximity_figure("mediocre-0.2", [], -76.5) is None


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_a_curve_with_gaps_is_still_drawn(value: float, tmp_path: Path) -> None:
    broken = LION | {"points": [point(0.0), point(1.0) | {"mean": value}]}
    figure = proximity_figure("toy", [broken], -76.5)
    assert figure is not None
    save_figure(figure, tmp_path / "figure.png")
