"""Cards: what is read, and the one sentence about what cannot be."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from components.core.cards import CardFormat


@dataclass(frozen=True)
class Card:
    """A small one."""

    name: str
    sizes: tuple[int, ...]
    extra: float = 0.5

    def __post_init__(self) -> None:
        """Refuse the empty name."""
        if not self.name:
            raise ValueError("its name is empty.")


def rename(values: dict[str, Any]) -> None:
    if "title" in values:
        values["name"] = values.pop("title")


CARDS = CardFormat(
    kind=Card, what="thing", remedy="make it again", version=("format_version", 2), amend=rename
)
WHOLE = {"format_version": 2, "name": "a", "sizes": [1, 2], "extra": 0.25}


def test_a_card_is_read_with_its_tuples(tmp_path: Path) -> None:
    path = tmp_path / "card.json"
    path.write_text(json.dumps(WHOLE))
    assert CARDS.read(path) == Card("a", (1, 2), 0.25)


def test_defaults_and_former_names_are_filled_in() -> None:
    text = json.dumps({"format_version": 2, "title": "a", "sizes": []})
    assert CARDS.parse(text, "x") == Card("a", (), 0.5)


def test_a_missing_card_is_named_with_its_remedy(tmp_path: Path) -> None:
    said = f"There is no thing in {tmp_path}: card.json is missing; make it again."
    with pytest.raises(FileNotFoundError, match=f"^{re.escape(said)}$"):
        CARDS.read(tmp_path / "card.json")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"{", "it is not JSON (Expecting"),
        (b"\xff\xfe", "it is not JSON ("),
        (b"[1]", "it is no JSON object"),
        ({"format_version": 1}, "its format version is 1 and this version reads 2"),
        ({"format_version": ...}, "its format version is None and this version reads 2"),
        ({"sizes": ...}, "it has missing or unknown fields (sizes)"),
        ({"colour": 1, "name": ...}, "it has missing or unknown fields (colour, name)"),
        ({"sizes": 3}, "'int' object is not iterable"),
        ({"name": ""}, "its name is empty"),
    ],
)
def test_a_card_that_cannot_be_used_says_why_in_one_sentence(
    content: bytes | dict[str, object], reason: str, tmp_path: Path
) -> None:
    path = tmp_path / "card.json"
    if isinstance(content, dict):
        values = {k: v for k, v in (WHOLE | content).items() if v is not ...}
        content = json.dumps(values).encode()
    path.write_bytes(content)
    beginning = re.escape(f"{path} cannot be used because {reason}")
    with pytest.raises(ValueError, match=rf"^{beginning}.*; make it again\.$"):
        CARDS.read(path)


def test_formats_without_versions_have_none() -> None:
    cards = CardFormat(kind=Card, what="thing", remedy="make it again")
    assert cards.parse('{"name": "a", "sizes": [3]}', "x") == Card("a", (3,))
    with pytest.raises(ValueError, match=r"unknown fields \(format_version\)"):
        cards.parse(json.dumps(WHOLE), "x")
