"""Draw the picture of docs/architecture.md from the code's own imports.

``python docs/draw_architecture.py`` writes ``docs/architecture.svg``; a test compares the file with
what the imports of today give. A room is a package directly below `components` or `flows`; the
modules directly in `flows` are the doors. An arrow leads from a room to one whose modules it
imports. Arrows that follow from others are left out: where tasks import models and models import
networks, tasks may import networks, too.
"""

import ast
from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "architecture.svg"
DOORS = "flows"

_WIDTH, _HEIGHT, _GAP, _RISE, _MARGIN = 132, 46, 34, 96, 24
_COLOURS = {"components": ("#e8f0fa", "#3b6ea5"), "flows": ("#fbf0e2", "#b0722b")}

_DIVIDED = ["components", "data"]
"""Shown with its inner rooms: what runs the real systems is apart from what learners read."""

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
            if name == top and not path.read_text(encoding="utf-8").strip():
                continue
            own = room(name)
            others = {room(module) for module in imports(path.read_text(encoding="utf-8"))}
            found.setdefault(own, set()).update(others - {own, "components"})
    # a task function is named in the plan, not imported by it; doors are imported by nobody
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
    """Rooms from the roof down: every room stands below all that import it, as high as it can.

    In a row, rooms are in the order of the middle of their importers, so that arrows cross little.
    """
    importers = {name: [o for o in edges if name in edges[o]] for name in edges}
    depth: dict[str, int] = {}

    def rank(name: str) -> int:
        if name not in depth:
            depth[name] = 1 + max(map(rank, importers[name]), default=-1)
        return depth[name]

    found: list[list[str]] = [[] for _ in range(1 + max(map(rank, edges)))]
    for name in sorted(edges):
        found[depth[name]].append(name)
    place: dict[str, float] = {}
    for row in found:
        middle = {n: sum(place[o] for o in importers[n]) / max(1, len(importers[n])) for n in row}
        row.sort(key=lambda name: (middle[name], name))
        place |= {name: n - (len(row) - 1) / 2 for n, name in enumerate(row)}
    return found


def draw() -> str:
    """The picture as SVG text, the same for the same imports."""
    edges = without_implied(arrows())
    floors = rows(edges)
    widest = max(len(row) for row in floors)
    width = 2 * _MARGIN + widest * _WIDTH + (widest - 1) * _GAP
    height = 2 * _MARGIN + _HEIGHT + (len(floors) - 1) * _RISE
    corner = {}
    for floor, row in enumerate(floors):
        left = (width - len(row) * _WIDTH - (len(row) - 1) * _GAP) / 2
        for n, name in enumerate(row):
            x = left + n * (_WIDTH + _GAP)
            corner[name] = (x, _MARGIN + floor * _RISE)
    shapes = [_line(corner[name], corner[t]) for name in edges for t in sorted(edges[name])]
    shapes += [_box(name, *at) for name, at in corner.items()]
    return _SHEET.format(width=f"{width:g}", height=f"{height:g}", shapes="\n".join(shapes))


def _line(start: tuple[float, float], end: tuple[float, float]) -> str:
    x, y = start[0] + _WIDTH / 2, start[1] + _HEIGHT
    to_x, to_y = end[0] + _WIDTH / 2, end[1] - 3
    bend = min(60.0, (to_y - y) / 2)
    path = f"M{x:g},{y:g} C{x:g},{y + bend:g} {to_x:g},{to_y - bend:g} {to_x:g},{to_y:g}"
    return f'<path d="{path}" class="arrow"/>'


def _box(name: str, x: float, y: float) -> str:
    top, _, label = name.partition(".")
    fill, line = _COLOURS[top]
    title = label.replace("_", " ").replace(".", " / ") or "doors"
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
