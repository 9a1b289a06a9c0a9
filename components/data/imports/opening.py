"""Opens what a command line names: files, folders of files, and datasets of Minari's."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from components.data.imports.csv_table import CsvFormat, CsvTable
from components.data.imports.minari_table import MinariTable
from components.data.imports.schema import LogError
from components.data.imports.tables import ParquetTable, Table
from components.data.sources.minari_exchange import minari_root

__all__ = ["MINARI", "open_tables"]

MINARI: Final = "minari:"
"""What stands before the id of a dataset of Minari's."""


def open_tables(words: Sequence[str], form: CsvFormat) -> list[Table]:
    """The tables of files, folders and Minari ids, in the order given; folders by name.

    Raises:
        LogError: There is no such file, or nothing can read it.
    """
    tables: list[Table] = []
    for word in words:
        path = Path(word).expanduser()
        if word.startswith(MINARI):
            dataset_id = word.removeprefix(MINARI)
            tables.append(MinariTable(dataset_id, minari_root()))
        elif path.is_dir():
            tables += _tables_below(path, form)
        elif path.is_file():
            tables.append(_table(path, word, form))
        else:
            raise LogError(f"there is no file {word}; give CSV or Parquet files, or minari:ID.")
    return tables


def _tables_below(folder: Path, form: CsvFormat) -> list[Table]:
    def natural(path: Path) -> list[Any]:  # run10 comes after run9
        return [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", path.name)]

    found = [p for p in folder.iterdir() if p.is_file() and not p.name.startswith((".", "_"))]
    tables = [_table(p, str(p), form) for p in sorted(found, key=natural)]
    if not tables:
        raise LogError(f"{folder} holds no files; give a folder of CSV or Parquet files.")
    return tables


def _table(path: Path, name: str, form: CsvFormat) -> Table:
    suffixes = [suffix.lower() for suffix in path.suffixes[-2:]]
    if suffixes[-1:] in ([".parquet"], [".pq"]):
        return ParquetTable(path, name)
    if suffixes[-1:] in ([".hdf5"], [".h5"]):
        raise LogError(
            f"{name} is HDF5, which is not read directly; fetch the set from Minari (`minari list "
            "remote`, D4RL's are there as D4RL/...) and give minari:ID, or write it as Parquet."
        )
    if suffixes[-1:] in ([".gz"], [".bz2"], [".zst"]):
        suffixes.pop()
    if suffixes[-1:] in ([".csv"], [".tsv"], [".txt"]):
        return CsvTable(path, name, form)
    raise LogError(f"{name} is neither CSV nor Parquet by its name; give .csv or .parquet.")
