"""The log of a small made-up furnace, as cells of text that tests may spoil, and its schema."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml

from components.data.dataset import OfflineDataset
from flows.import_log import import_log, load_import_settings

Cells = dict[str, list[str]]

EPISODES, ROWS = 6, 30
SCHEMA = {
    "features": ["temperature", "oxygen"],
    "actions": {"gas": [0, 100], "air": [0, 50]},
    "reward": "profit",
    "outcome_row": "after",
    "episode": "run",
    "time": "time",
    "sampling": 10,
    "history": 4,
    "discount": 0.97,
}


def furnace(episodes: int = EPISODES, rows: int = ROWS) -> Cells:
    """Cells of the log; temperature follows the gas, and profit the temperature."""
    rng = np.random.default_rng(5)
    gas, air = rng.uniform(10, 90, (episodes, rows)), rng.uniform(5, 45, (episodes, rows))
    temperature, oxygen = np.empty_like(gas), np.empty_like(gas)
    temperature[:, 0], oxygen[:, 0] = rng.uniform(780, 820, episodes), rng.uniform(4, 6, episodes)
    for t in range(rows - 1):
        temperature[:, t + 1] = 0.9 * temperature[:, t] + 1.6 * gas[:, t] + rng.normal(0, 1)
        oxygen[:, t + 1] = 0.8 * oxygen[:, t] + 0.04 * air[:, t]
    begin = np.datetime64("2026-03-01T00:00:00")
    seconds = 10 * np.arange(rows) + 100_000 * np.arange(episodes)[:, None]
    columns = {
        "temperature": temperature,
        "oxygen": oxygen,
        "gas": gas,
        "air": air,
        "profit": -np.abs(temperature - 800),
    }
    cells = {name: [f"{x:.3f}" for x in values.ravel()] for name, values in columns.items()}
    cells["run"] = [str(e) for e in range(episodes) for _ in range(rows)]
    cells["time"] = [str(begin + np.timedelta64(int(s), "s")) for s in seconds.ravel()]
    return cells


def as_csv(cells: Cells, delimiter: str = ",") -> str:
    """The cells as the text of a CSV file."""
    lines = [delimiter.join(cells)]
    lines += [delimiter.join(row) for row in zip(*cells.values(), strict=True)]
    return "\n".join(lines) + "\n"


def write_schema(folder: Path, **changes: object) -> Path:
    """A schema file; a change to None leaves a key out."""
    fields = {k: v for k, v in {**SCHEMA, **changes}.items() if v is not None}
    path = folder / "furnace.yaml"
    path.write_text(yaml.safe_dump(fields, sort_keys=False), encoding="utf-8")
    return path


def put(column: str, row: int, value: str) -> Callable[[Cells], None]:
    """Writes a value into a row, which is counted as a spreadsheet does."""

    def spoil(cells: Cells) -> None:
        cells[column][row - 2] = value

    return spoil


def imported(cells: Cells, *words: str, **changes: object) -> OfflineDataset:
    """What an import in the working folder stores."""
    Path("log.csv").write_text(as_csv(cells), encoding="utf-8")
    write_schema(Path.cwd(), **changes)
    assert import_log(load_import_settings(["log.csv", "name=furnace", *words])) == 0
    return OfflineDataset.open(Path("logs/furnace"))
