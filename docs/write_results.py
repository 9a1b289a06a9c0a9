"""Write the tables of published results into README.md: ``python docs/write_results.py``.

A folder of docs/results is what ``python -m flows.report sweep=NAME out=docs/results/NAME`` has
written. README.md holds its table between ``<!-- results: NAME -->`` and ``<!-- end -->``.
"""

import re
from pathlib import Path
from typing import Final

from components.reporting.published import published_table

__all__ = ["with_results"]

ROOT: Final = Path(__file__).parents[1]
README: Final = ROOT / "README.md"
RESULTS: Final = ROOT / "docs" / "results"
_PLACE: Final = re.compile(r"(<!-- results: ([\w.-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def with_results(text: str, results: Path) -> str:
    """A text whose tables are those of the published results.

    Args:
        text: With places for them.
        results: The folder of published results.

    Raises:
        DamagedFileError: A place names results that are not there.
    """

    def filled(place: re.Match[str]) -> str:
        return f"{place[1]}\n{published_table(results / place[2])}\n{place[3]}"

    return _PLACE.sub(filled, text)


if __name__ == "__main__":
    README.write_text(with_results(README.read_text(encoding="utf-8"), RESULTS), encoding="utf-8")
