"""The page about the structure tells the truth: its picture, and every file it names."""

import re

import pytest

from docs import draw_architecture as drawing

PAGE = drawing.ROOT / "docs" / "architecture.md"


def test_the_picture_is_what_the_imports_give() -> None:
    assert drawing.PICTURE.read_text(encoding="utf-8") == drawing.draw(), (
        "The imports have changed: run `python docs/draw_architecture.py` and look at the picture."
    )


def test_implied_arrows_are_left_out_and_rooms_stand_above_what_they_import() -> None:
    edges = {"roof": {"wall", "ground"}, "wall": {"ground"}, "ground": set(), "shed": {"ground"}}
    assert drawing.without_implied(edges)["roof"] == {"wall"}
    assert drawing.rows(edges) == [["roof", "shed"], ["wall"], ["ground"]]


def test_every_arrow_is_an_import() -> None:
    found = drawing.arrows()
    assert "components.networks" in found["components.training"]
    assert "components.environments" not in found["components.algorithms"]
    assert found["components.core"] == set()


def test_every_file_the_page_names_exists() -> None:
    text = PAGE.read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:components|flows|conf|tests|docs|benchmarks)/[\w./-]+)`", text))
    if len(named) < 30:
        pytest.fail(f"the page names only {len(named)} files; is the pattern still right?")
    there = {name for name in named if (drawing.ROOT / name).exists()}
    missing = sorted(name for name in named - there if "NAME" not in name)
    assert not missing
