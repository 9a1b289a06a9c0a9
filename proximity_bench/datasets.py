"""Opens logs: by name, from tables with a schema, from folders and from Minari."""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

import pandas as pd

from components.core.integrity import MissingFileError
from components.data.dataset import OfflineDataset
from components.data.imports.csv_table import CsvFormat
from components.data.imports.frame_of_rows import DataFrameTable
from components.data.imports.importing import import_tables
from components.data.imports.schema import LogSchema, Repairs
from components.data.imports.tables import Table
from components.data.sources.source import DatasetSource, generate
from flows.configuration.composition import base_layers
from flows.configuration.given import settings_of
from flows.configuration.log_schemas import checked_schema, fields_in
from flows.planning.nodes import data_node

__all__ = ["PROFILE", "DoubtfulLogWarning", "dataset"]

PROFILE: Final = "paper"
"""Whose settings hold where none are given: the defaults, and what datasets and domains change."""
_MINARI: Final = "minari:"
_CARD: Final = "card.json"

Schema = LogSchema | Mapping[str, Any] | str | Path


class DoubtfulLogWarning(UserWarning):
    """Something in a table looks wrong; it can be used, and its owner knows what is meant."""


def dataset(
    source: str | Path | pd.DataFrame,
    *,
    schema: Schema | None = None,
    name: str | None = None,
    missing: Literal["refuse", "drop_episode", "forward_fill"] = "refuse",
    gaps: Literal["refuse", "split"] = "refuse",
    short: Literal["refuse", "drop"] = "refuse",
    seed: int = 0,
    cache: str | Path | None = None,
    threads: int = 1,
    **sizes: int,
) -> OfflineDataset:
    """Open a log, or make it.

    What looks wrong in a table is a :class:`DoubtfulLogWarning`, a sentence each.

    Args:
        source: A name of conf/dataset, whose log is generated; a folder that
            `OfflineDataset.write`, `flows.import_log` or a sweep has filled; a DataFrame, a file or
            a folder of CSV or Parquet; or `minari:ID`.
        schema: What the columns of a table mean: a mapping, a YAML file or a `LogSchema`, see
            docs/own_log.md. Exports of this project to Minari need none.
        name: Of the dataset; a random stream belongs to it. "log" for tables, else its own.
        missing: What to do about missing values of a table.
        gaps: About gaps in its time.
        short: About episodes without a single whole step.
        seed: Of the generation.
        cache: Folder that keeps generated logs, so that they are made once; None: in memory alone.
        threads: Of the generation; the log does not depend on it.
        sizes: Of a generated log: `trajectories` and `steps`; of a robot's `transitions`.

    Raises:
        FileNotFoundError: There is no such folder or file; a ValueError, too.
        ValueError: The source is unknown, or the log cannot be used; one sentence.
    """
    if isinstance(source, str) and source in base_layers(PROFILE).base["dataset"]:
        _refuse("schema", schema, f"{source} is generated")
        made = _generated(source, seed, sizes, Path(cache).expanduser() if cache else None, threads)
        return _renamed(made, name)
    _refuse("sizes", sizes or None, "a stored log has its own")
    _refuse("cache", cache, "nothing is generated")
    if isinstance(source, str | Path) and not _is_table(source):
        _refuse("schema", schema, f"{source} is a dataset already")
        return _renamed(OfflineDataset.open(Path(source).expanduser()), name)
    if isinstance(source, str) and source.startswith(_MINARI):
        exported = _own_export(source.removeprefix(_MINARI))
        if exported is not None:
            _refuse("schema", schema, f"{source} was exported by this project")
            return _renamed(exported, name)
    columns = _schema(schema, source)
    tables = _tables(source, CsvFormat.of(columns))
    own = _free_name(name or "log")
    imported = import_tables(tables, columns, Repairs(missing, gaps, short), own)
    for sentence in imported.warnings:
        warnings.warn(sentence, DoubtfulLogWarning, stacklevel=2)
    return imported.dataset


def _refuse(argument: str, value: object, because: str) -> None:
    if value is not None:
        raise ValueError(f"{argument}={value!r} has no use: {because}; leave it out.")


def _is_table(source: str | Path) -> bool:
    """Whether a source is a table rather than a dataset.

    Raises:
        ValueError: It is nothing that is known.
    """
    if isinstance(source, str) and source.startswith(_MINARI):
        return True
    path = Path(source).expanduser()
    if not path.exists():
        if isinstance(source, Path) or len(path.parts) > 1 or path.suffix in (".csv", ".parquet"):
            remedy = "give a folder, a file or a name of conf/dataset"
            raise MissingFileError(f"There is no {source}", path, remedy)
        settings_of(PROFILE, {"datasets": [source]}, {})  # names the known ones
    return not (path / _CARD).is_file()


def _generated(
    name: str, seed: int, sizes: Mapping[str, int], cache: Path | None, threads: int
) -> OfflineDataset:
    """A dataset of conf/dataset, from the cache if it is there."""
    given = {"datasets": [name], "data": {"seed": seed, **sizes}}
    settings = settings_of(PROFILE, given, {})
    source: DatasetSource = settings.dataset[name]
    if cache is None:
        return generate(source, settings.data.seed, threads)
    folder = cache / f"{name}-{data_node(settings, name).key[:16]}"
    if not (folder / _CARD).is_file():
        generate(source, settings.data.seed, threads).write(folder)
    return OfflineDataset.open(folder)


def _renamed(log: OfflineDataset, name: str | None) -> OfflineDataset:
    """The log under another name; its card is otherwise the same."""
    if name is None or name == log.card.name:
        return log
    return replace(log, card=replace(log.card, name=_free_name(name)))


def _free_name(name: str) -> str:
    """A name that no generated dataset has, whose settings would be meant otherwise.

    Raises:
        ValueError: There is such a dataset.
    """
    fields = base_layers(PROFILE).base["dataset"].get(name)
    if fields is not None and "log" not in fields:
        raise ValueError(f"name={name!r} is a generated dataset of conf/dataset; choose another.")
    return name


def _own_export(dataset_id: str) -> OfflineDataset | None:
    """What this project has exported to Minari; None for datasets of others."""
    from components.data.imports.minari_table import MinariTable  # Minari is slow to import
    from components.data.sources.minari_exchange import (
        ForeignDatasetError,
        import_minari,
        minari_root,
    )

    table = MinariTable(dataset_id, minari_root())
    _ = table.folder  # refuses files that would read others
    try:
        return import_minari(dataset_id, table.root)
    except ForeignDatasetError:
        return None


def _schema(schema: Schema | None, source: object) -> LogSchema:
    """A checked schema."""
    if isinstance(schema, LogSchema):
        return schema
    if schema is None:
        what = source if isinstance(source, str | Path) else "A DataFrame"
        raise ValueError(
            f"{what} needs schema=, what its columns mean: a mapping or a YAML file, see "
            "docs/own_log.md."
        )
    place, fields = "schema", schema
    if isinstance(schema, str | Path):
        place = str(schema)
        if not Path(schema).expanduser().is_file():
            raise MissingFileError(f"There is no schema {schema}", None, "see docs/own_log.md")
        fields = fields_in(Path(schema).expanduser())
    return checked_schema(fields, place)


def _tables(source: str | Path | pd.DataFrame, form: CsvFormat) -> list[Table]:
    if isinstance(source, pd.DataFrame):
        return [DataFrameTable(source)]
    from components.data.imports.opening import open_tables  # brings Minari, slow to import

    return open_tables([str(source)], form)
