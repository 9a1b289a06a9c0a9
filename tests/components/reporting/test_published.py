"""Published results: the table made of their policies is that of the report."""

from pathlib import Path

import numpy as np
import pytest

from components.core.integrity import DamagedFileError
from components.reporting.overview_text import markdown_overview
from components.reporting.published import publish, published_table
from docs.write_results import README, RESULTS, with_results
from tests.components.reporting.evidence import CELLS, evidence


def test_the_table_is_made_of_the_policies_alone(tmp_path: Path) -> None:
    publish(tmp_path, evidence())
    table = published_table(tmp_path)
    lines = table.splitlines()
    # Two policies one above and one below the mean: the 10th percentile is 0.8 below it, as in the
    # evidence's own points.
    assert lines[:5] == markdown_overview(evidence().table).splitlines()[:5]
    assert "² less." in lines
    assert "Something <b>odd</b> happened." in lines
    assert lines[-1] == "    python -m flows.full_benchmark sweep=toy"


def test_unknown_levels_stay_unknown(tmp_path: Path) -> None:
    counted = {
        (c.dataset, c.algorithm): c.__class__(**{**c.__dict__, "level": None}) for c in CELLS
    }
    publish(tmp_path, evidence(cells=counted))
    assert "| bad-0.4 |  | -220.8 |" in published_table(tmp_path)
    assert not np.isnan(evidence().cells["bad-0.4", "bc"].level or np.nan)


def test_places_in_a_text_are_filled_and_filled_again(tmp_path: Path) -> None:
    (tmp_path / "toy").mkdir()
    publish(tmp_path / "toy", evidence())
    text = "Before\n<!-- results: toy -->\nold\n<!-- end -->\nAfter\n"
    once = with_results(text, tmp_path)
    assert once.startswith("Before\n<!-- results: toy -->\n\n| dataset | logged |")
    assert once.endswith("\n<!-- end -->\nAfter\n")
    assert "old" not in once
    assert with_results(once, tmp_path) == once
    with pytest.raises(DamagedFileError, match=r"gone/about\.json is missing; write it again by"):
        with_results(text.replace("toy", "gone"), tmp_path)


def test_the_readme_has_the_tables_of_the_published_results() -> None:
    text = README.read_text(encoding="utf-8")
    assert with_results(text, RESULTS) == text, "run `python docs/write_results.py`"
    published = {path.parent.name for path in RESULTS.glob("*/about.json")}
    assert published == {name for name in published if f"<!-- results: {name} -->" in text}
