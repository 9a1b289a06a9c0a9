"""Draw the picture of docs/architecture.md from the code's own imports.

``python docs/draw_architecture.py`` writes ``docs/architecture.svg``; a test compares the file with
what the imports of today give. A room is a package directly below `components` or `flows`; the
modules directly in `flows` are the doors, and `proximity_bench` is the library. An arrow leads from
a room to one whose modules it imports. Arrows that follow from others are left out: where tasks
import models and models import networks, tasks may import networks, too.
"""

import ast
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "architecture.svg"
DOORS = "flows"

_WIDTH, _HEIGHT, _GAP, _LANE, _RISE, _MARGIN = 132, 46, 26, 6, 96, 24
_COLOURS = {
    "components": ("#e8f0fa", "#3b6ea5"),
    "flows": ("#fbf0e2", "#b0722b"),
    "proximity_bench": ("#e9f5ea", "#4a8a52"),
}
_TOPS = {"flows": "doors", "proximity_bench": "library"}
"""What is called so that is no room below another package."""

_DIVIDED = ["components", "data"]
"""Shown with its inner rooms: what runs the real systems is separate from what learners read."""

Edges = Mapping[str, set[str]]


def room(module: str) -> str:
    """The room of a dotted module name."""
    parts = module.split(".")
    depth = 3 if parts[:2] == _DIVIDED else 2
    while depth > 1 and not ROOT.joinpath(*parts[:depth]).is_dir():
        depth -= 1
    return ".".join(parts[:depth])


def imports(source: str) -> Iterator[str]:
    """Modules of this project that a source text imports."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found = [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            # a name may be a module of the package, so that its room is the package's or its own
            found = [f"{node.module}.{name.name}" for name in node.names]
        else:
            continue
        yield from (name for name in found if name.split(".")[0] in _COLOURS)


def arrows() -> dict[str, set[str]]:
    """The rooms that each room imports."""
    found: dict[str, set[str]] = {}
    for top in _COLOURS:
        for path in sorted((ROOT / top).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            if name == "components":  # only a docstring; its rooms are drawn
                continue
            own = room(name)
            others = {room(module) for module in imports(path.read_text(encoding="utf-8"))}
            found.setdefault(own, set()).update(others - {own, "components"})
    # a plan names a task function and does not import it; doors are imported by no module
    return {name: targets - {DOORS} for name, targets in found.items()}


def without_implied(edges: Edges) -> dict[str, set[str]]:
    """The same arrows without those that follow from others."""
    below = {name: _reach(edges, name) for name in edges}
    return {
        name: {t for t in targets if not any(t in below[o] for o in targets if o != t)}
        for name, targets in edges.items()
    }


def _reach(edges: Edges, start: str) -> set[str]:
    seen: set[str] = set()
    rest = list(edges.get(start, ()))
    while rest:
        name = rest.pop()
        if name not in seen:
            seen.add(name)
            rest.extend(edges.get(name, ()))
    return seen


def rows(edges: Edges) -> list[list[str]]:
    """Rooms by row, the top row first: every room is in the row below its lowest importer."""
    importers = {name: [o for o in edges if name in edges[o]] for name in edges}
    depth: dict[str, int] = {}

    def rank(name: str) -> int:
        if name not in depth:
            depth[name] = 1 + max(map(rank, importers[name]), default=-1)
        return depth[name]

    found: list[list[str]] = [[] for _ in range(1 + max(map(rank, edges)))]
    for name in sorted(edges):
        found[depth[name]].append(name)
    return found


def routes(floors: Sequence[Sequence[str]], edges: Edges) -> list[list[str]]:
    """Every arrow as the places it passes, one a row: a room, gaps `from>to`, a room."""
    floor = {name: n for n, row in enumerate(floors) for name in row}
    return [
        [name, *[f"{name}>{target}"] * (floor[target] - floor[name] - 1), target]
        for name in sorted(edges)
        for target in sorted(edges[name])
    ]


def arranged(floors: Sequence[Sequence[str]], paths: Sequence[Sequence[str]]) -> list[list[str]]:
    """Rooms and gaps of every row, ordered so that arrows cross little.

    Each place goes to the middle of its neighbours in the row above, then of those below, in turn
    (the barycentre method of Sugiyama, Tagawa and Toda, 1981).
    """
    start = {name: n for n, row in enumerate(floors) for name in row}
    ordered = [list(row) for row in floors]
    links: set[tuple[int, str, str]] = set()
    for path in paths:
        for n, (upper, lower) in enumerate(pairwise(path), start=start[path[0]]):
            links.add((n, upper, lower))
            if lower not in start and lower not in ordered[n + 1]:
                ordered[n + 1].append(lower)
    for sweep in range(24):
        downwards = sweep % 2 == 0
        for n in range(len(ordered)) if downwards else reversed(range(len(ordered))):
            beside = n - 1 if downwards else n + 1
            if not 0 <= beside < len(ordered):
                continue
            at = {name: x for name, x, _ in _placed(ordered[beside])}
            middle = {name: x for name, x, _ in _placed(ordered[n])}
            for name in ordered[n]:
                near = [
                    at[upper if downwards else lower]
                    for row, upper, lower in links
                    if row == min(n, beside) and name == (lower if downwards else upper)
                ]
                if near:
                    middle[name] = sum(near) / len(near)
            ordered[n].sort(key=lambda name, middle=middle: (middle[name], name))
    return ordered


def _placed(row: Sequence[str]) -> list[tuple[str, float, float]]:
    """Name, middle and width of the places of a row, around 0."""
    widths = [_LANE if ">" in name else _WIDTH for name in row]
    left = -(sum(widths) + _GAP * (len(row) - 1)) / 2
    found = []
    for name, width in zip(row, widths, strict=True):
        found.append((name, left + width / 2, width))
        left += width + _GAP
    return found


def draw() -> str:
    """The picture as SVG text, the same for the same imports."""
    edges = without_implied(arrows())
    floors = rows(edges)
    paths = routes(floors, edges)
    ordered = arranged(floors, paths)
    width = 2 * _MARGIN + max(2 * (_placed(row)[-1][1] + _WIDTH / 2) for row in ordered)
    height = 2 * _MARGIN + _HEIGHT + (len(floors) - 1) * _RISE
    places = [{name: x + width / 2 for name, x, _ in _placed(row)} for row in ordered]
    floor = {name: n for n, row in enumerate(floors) for name in row}
    shapes = [_arrow(path, floor[path[0]], places) for path in paths]
    shapes += [
        _box(name, places[n][name] - _WIDTH / 2, _MARGIN + n * _RISE)
        for n, row in enumerate(ordered)
        for name in row
        if ">" not in name
    ]
    return _SHEET.format(width=f"{width:g}", height=f"{height:g}", shapes="\n".join(shapes))


def _arrow(path: Sequence[str], first: int, places: Sequence[Mapping[str, float]]) -> str:
    """A curve that runs straight through the rows it passes and bends between them."""
    x, y = places[first][path[0]], _MARGIN + first * _RISE + _HEIGHT
    drawn = f"M{x:g},{y:g}"
    for n, name in enumerate(path[1:], start=first + 1):
        to_x, top = places[n][name], _MARGIN + n * _RISE
        to_y, half = top - 3, (top - y) / 2
        drawn += f" C{x:g},{y + half:g} {to_x:g},{to_y - half:g} {to_x:g},{to_y:g}"
        if ">" in name:
            drawn += f" L{to_x:g},{top + _HEIGHT:g}"
        x, y = to_x, top + _HEIGHT
    return f'<path d="{drawn}" class="arrow"/>'


def _box(name: str, x: float, y: float) -> str:
    top, _, label = name.partition(".")
    fill, line = _COLOURS[top]
    title = label.replace("_", " ").replace(".", " / ") or _TOPS[top]
    return (
        f'<g><rect x="{x:g}" y="{y:g}" width="{_WIDTH}" height="{_HEIGHT}" rx="6" fill="{fill}" '
        f'stroke="{line}"/><text x="{x + _WIDTH / 2:g}" y="{y + 20:g}">{escape(title)}</text>'
        f'<text x="{x + _WIDTH / 2:g}" y="{y + 36:g}" class="top">{top}/</text></g>'
    )


_SHEET = """\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" \
height="{height}" role="img" aria-label="Rooms of the project and which import which">
<style>
  text {{ font: 14px sans-serif; text-anchor: middle; fill: #1f2933; }}
  .top {{ font-size: 11px; fill: #6b7785; }}
  .arrow {{ fill: none; stroke: #8a97a6; stroke-width: 1.2; marker-end: url(#tip); }}
</style>
<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" \
orient="auto"><path d="M0,0 L8,4 L0,8 z" fill="#8a97a6"/></marker></defs>
<rect width="100%" height="100%" fill="white"/>
{shapes}
</svg>
"""


def main() -> None:
    """Write the picture."""
    PICTURE.write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    main()
