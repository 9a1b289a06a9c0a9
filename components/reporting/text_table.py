"""A table of words, laid out for a width; it needs no library, so commands show it at once."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

__all__ = ["TextTable"]

_GAP: Final = "  "


@dataclass(frozen=True)
class TextTable:
    """An overview as words, before the width of a window breaks it into blocks.

    Attributes:
        names: Of the columns, "logged" first.
        places: Where on the proximity's range each is.
        labels: Of the rows; those that belong to the dataset above are indented.
        rows: A word per column.
    """

    names: Sequence[str]
    places: Sequence[str]
    labels: Sequence[str]
    rows: Sequence[Sequence[str]]

    def text(self, width: int) -> str:
        """Aligned text; what is wider than the window goes on below.

        Args:
            width: Of the window in characters.
        """
        labels, rows, places = self.labels, self.rows, self.places
        wide = [max(map(len, cells)) for cells in zip(self.names, places, *rows, strict=True)]
        first = max(map(len, ("dataset", *labels)))
        blocks = []
        for chosen in _blocks(first, wide, width):

            def line(label: str, cells: Sequence[str], chosen: Sequence[int] = chosen) -> str:
                return label.ljust(first) + "".join(_GAP + cells[n].rjust(wide[n]) for n in chosen)

            head = [line("dataset", self.names)]
            if any(places[n].strip() for n in chosen):
                head.append(line("", places))
            body = [
                line(label, row)
                for label, row in zip(labels, rows, strict=True)
                if not label.startswith(" ") or any(row[n].strip() for n in chosen)
            ]
            lines = [*head, "-" * len(head[0]), *body]
            blocks.append("".join(text.rstrip() + "\n" for text in lines))
        return "\n".join(blocks)


def _blocks(first: int, wide: Sequence[int], width: int) -> list[list[int]]:
    """Numbers of the columns that stand beside each other; "logged" begins every block."""
    blocks: list[list[int]] = []
    taken = width  # so that the first column begins a block
    for n in range(1, len(wide)):
        needed = len(_GAP) + wide[n]
        if taken + needed > width:
            blocks.append([0])
            taken = first + len(_GAP) + wide[0]
        blocks[-1].append(n)
        taken += needed
    return blocks
