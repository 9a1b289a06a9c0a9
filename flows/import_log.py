"""Import a log of your own: ``python -m flows.import_log FILE... name=furnace [--describe]``."""

import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from omegaconf import OmegaConf
from pydantic import AfterValidator, Field
from rich.console import Console

from components.core.files import temporary_name, write_text
from components.data.card import DatasetCard
from components.data.imports.csv_table import CsvFormat
from components.data.imports.describe import draft_schema
from components.data.imports.importing import Imported, import_tables
from components.data.imports.minari_table import MinariTable
from components.data.imports.opening import MINARI, open_tables
from components.data.imports.report import FIGURE, report_figure, report_text
from components.data.imports.schema import LogError, LogSchema, Repairs
from components.data.imports.tables import Table
from components.data.sources.minari_exchange import ForeignDatasetError, import_minari
from components.environments.systems import SYSTEMS
from components.models.recurrent_ensemble.ensemble import RecurrentEnsembleConfig
from flows.command_line import command_words, run_door
from flows.configuration import files
from flows.configuration.checking import SettingsError, StrictModel, build_config
from flows.configuration.files import shown
from flows.configuration.log_schemas import checked_schema, fields_in
from flows.configuration.plants import settings_of_log
from flows.configuration.words import fields_of_words
from flows.planning.judging import LEAST_EPISODES

__all__ = ["ImportSettings", "import_log", "load_import_settings", "read_schema"]

HELP = """\
usage: python -m flows.import_log FILE... name=NAME [KEY=VALUE ...]

Make a dataset of a log of your own: CSV and Parquet files, folders of them, or minari:ID, a dataset
of Minari's on this computer. Afterwards datasets=[NAME] works like any other.

  name=furnace            of the dataset; must not be one of conf/dataset
  schema=furnace.yaml     what the columns mean; NAME.yaml by default
  --describe              write a first draft of that file from the columns, and stop; a file that
                          is there is left alone
  missing=refuse          missing and infinite values: refuse the log, drop_episode or forward_fill
  gaps=refuse             gaps in time: refuse the log, or split: a new episode begins after each
  short=refuse            episodes without one whole step: refuse the log, or drop them
  to=logs/furnace         folder of the dataset and its report; logs/NAME of the project by default
  replace=true            put it in the place of an earlier import

A log that cannot be used is refused in one sentence with file, row and column, and nothing is
stored. A dataset that this project exported to Minari needs no schema and comes back as it was.
With the environment variable PROXIMITY_BENCH_HOME=FOLDER all goes there instead of into the
project, and every command that is given the same variable finds it there.
"""

_REPORT = "report.md"
_SWITCHES = ("describe", "replace")


def _plain_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", name):
        raise SettingsError(
            f"name={name!r} cannot be used: a name has letters, digits, . _ and - only, begins "
            "with a letter or a digit, and has at most 100 characters."
        )
    return name


class ImportSettings(StrictModel):
    """What to import, how to repair it and where to put it."""

    files: tuple[str, ...] = Field(min_length=1)
    name: Annotated[str, AfterValidator(_plain_name)]
    schema_file: Path | None = Field(default=None, alias="schema")
    describe: bool = False
    missing: Literal["refuse", "drop_episode", "forward_fill"] = "refuse"
    gaps: Literal["refuse", "split"] = "refuse"
    short: Literal["refuse", "drop"] = "refuse"
    to: Path | None = None
    replace: bool = False

    @property
    def described_by(self) -> Path:
        """The schema file."""
        return self.schema_file or Path(f"{self.name}.yaml")

    @property
    def folder(self) -> Path:
        """Where the dataset is put: beside conf/, as it is no product of a store."""
        return files.home() / (self.to or Path("logs", self.name))

    @property
    def named_in(self) -> Path:
        """The file of conf/dataset."""
        return files.home() / "conf" / "dataset" / f"{self.name}.yaml"


def load_import_settings(words: Sequence[str]) -> ImportSettings:
    """Settings from the command line.

    Raises:
        SettingsError: One sentence.
    """
    paths = [w for w in words if "=" not in w and w[:1] != "-" and w not in _SWITCHES]
    fields = fields_of_words(
        [word for word in words if word not in paths], on_off=_SWITCHES, switches=_SWITCHES
    )
    if not paths:
        raise SettingsError("no file is given; write e.g. log.csv name=furnace.")
    if "name" not in fields:
        raise SettingsError("name= is missing; write e.g. name=furnace.")
    if "files" in fields:
        raise SettingsError("files are given without a key; write e.g. log.csv name=furnace.")
    settings: ImportSettings = build_config(ImportSettings, "", {"files": paths, **fields})
    return settings


def read_schema(path: Path) -> LogSchema:
    """The schema in a YAML file.

    Raises:
        SettingsError: There is none, or it is wrong; one sentence.
    """
    if not path.is_file():
        raise SettingsError(
            f"{path} is missing; add --describe to write a first draft of it, or give schema=FILE."
        )
    fields = fields_in(path)
    try:
        return checked_schema(fields)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from error


def import_log(settings: ImportSettings) -> int:
    """Import a log, or draft its schema.

    Raises:
        SettingsError: The log, its schema or the settings cannot be used; nothing is stored.
    """
    try:
        if settings.describe:
            return _describe(settings)
        _check_place(settings)
        own = _own_export(settings)
        if own is not None:
            imported, names, text = own, list(settings.files), None
        else:
            schema = read_schema(settings.described_by)
            text = settings.described_by.read_text(encoding="utf-8")
            tables = open_tables(settings.files, CsvFormat.of(schema))
            names = [table.name for table in tables]
            imported = _imported(tables, schema, settings)
        warnings = [*imported.warnings, *_too_little(imported.dataset.card)]
        _store(replace(imported, warnings=warnings), names, text, settings)
    except LogError as error:
        raise SettingsError(str(error)) from error
    return 0


def _describe(settings: ImportSettings) -> int:
    path = settings.described_by
    if path.exists():
        raise SettingsError(
            f"{path} is there already and is left alone; remove it for a new draft."
        )
    for form in (CsvFormat(), CsvFormat(";"), CsvFormat("\t"), CsvFormat("|")):
        tables = open_tables(settings.files, form)
        try:
            if len(tables[0].columns) > 1:
                break
        except LogError as error:
            if "separates" not in str(error):
                raise
    else:  # a single column
        tables = open_tables(settings.files, CsvFormat())
    write_text(path, draft_schema(tables, settings.name))
    print(f"{path}: a first draft of the schema. Correct it, then repeat this without --describe.")
    return 0


def _check_place(settings: ImportSettings) -> None:
    """Refuse names and folders that are taken."""
    folder, named = settings.folder, settings.named_in
    if settings.name == "all":
        raise SettingsError("name=all stands for every dataset; choose another name.")
    project = files.CONF / "dataset"
    if not project.is_dir():
        raise SettingsError(f"{project} is missing; import in a whole copy of the project.")
    taken = project / named.name
    if taken != named and taken.exists():
        raise SettingsError(
            f"name={settings.name} is that of a dataset of this project; choose another name."
        )
    if named.exists() and not _names_folder(named, settings):
        raise SettingsError(
            f"name={settings.name}: {shown(named)} is there already and is not about "
            f"{shown(folder)}; choose another name, or remove it."
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        if not settings.replace:
            raise SettingsError(
                f"{shown(folder)} is there already; give replace=true, or another name."
            )
        if not (folder / "card.json").is_file():
            raise SettingsError(f"to={shown(folder)} holds no dataset to replace; name another.")


def _names_folder(named: Path, settings: ImportSettings) -> bool:
    """Whether a file of conf/dataset is about the folder of this import."""
    content: Any = OmegaConf.to_container(files.read_file(named), resolve=False)
    fields = content.get(settings.name)
    log = fields.get("log") if isinstance(fields, Mapping) else None
    return isinstance(log, str) and files.home() / log == settings.folder


def _own_export(settings: ImportSettings) -> Imported | None:
    """A dataset that this project has exported, exactly as it was; None for any other.

    Raises:
        SettingsError: It is damaged.
    """
    if len(settings.files) != 1 or not settings.files[0].startswith(MINARI):
        return None
    [table] = open_tables(settings.files, CsvFormat())
    assert isinstance(table, MinariTable)
    _ = table.folder  # refuses files that would read others
    try:
        dataset = import_minari(table.dataset_id, table.root)
    except ForeignDatasetError:
        return None
    except ValueError as error:
        raise SettingsError(str(error)) from error
    return Imported(dataset, len(dataset.frames), ["It was exported by this project."], [])


def _imported(tables: Sequence[Table], schema: LogSchema, settings: ImportSettings) -> Imported:
    repairs = Repairs(settings.missing, settings.gaps, settings.short)
    console = Console(stderr=True, highlight=False)
    with console.status("reading") as status:

        def progress(table: str, rows: int) -> None:
            status.update(f"reading {table}: {rows:,} rows so far")

        return import_tables(tables, schema, repairs, settings.name, progress)


def _store(
    imported: Imported, names: Sequence[str], schema: str | None, settings: ImportSettings
) -> None:
    """Put the dataset, its report and its schema into one folder, and name it in conf/dataset."""
    folder, dataset = settings.folder, imported.dataset
    command = shlex.join(["python", *command_words()])
    folder.parent.mkdir(parents=True, exist_ok=True)
    with temporary_name(folder) as made:
        dataset.write(made)
        if schema is not None:
            write_text(made / "schema.yaml", schema)
        write_text(made / _REPORT, report_text(imported, names, command))
        report_figure(dataset).savefig(made / FIGURE, dpi=110)
        _put(made, folder)
    if not settings.named_in.exists():
        about = f"# imported by flows.import_log; {_REPORT} in its folder says what it holds\n"
        own = {"log": str(_below_home(folder)), **settings_of_log(dataset.card)}
        content = {settings.name: own}
        settings.named_in.parent.mkdir(parents=True, exist_ok=True)
        write_text(settings.named_in, about + yaml.safe_dump(content, allow_unicode=True))
    _say(imported, settings)


def _below_home(folder: Path) -> Path:
    """A folder as files of conf/dataset name it."""
    home = files.home()
    return folder.relative_to(home) if folder.is_relative_to(home) else folder


def _too_little(card: DatasetCard) -> list[str]:
    """What a sweep over a log will leave out, as the log is too small for it."""
    if card.environment in SYSTEMS:
        return []
    said = []
    if card.trajectories < LEAST_EPISODES:
        said.append(
            f"The log has {card.trajectories} episodes, but it takes {LEAST_EPISODES} to divide it "
            "into a part to learn from and one to judge by: its policies will not be judged."
        )
    model = RecurrentEnsembleConfig()
    needed = model.warm_up + model.horizon
    if card.steps < needed:
        said.append(
            f"The longest episode has {card.steps} steps, but models that read histories need "
            f"{needed}: algorithms that learn with them refuse the log, and critics judge alone."
        )
    return said


def _put(made: Path, folder: Path) -> None:
    """Rename a folder, in the place of another one if there is one."""
    if not folder.exists():
        os.replace(made, folder)
        return
    with temporary_name(folder) as former:
        os.replace(folder, former)
        try:
            os.replace(made, folder)
        except OSError:
            os.replace(former, folder)
            raise


def _say(imported: Imported, settings: ImportSettings) -> None:
    dataset = imported.dataset
    for sentence in imported.warnings:
        print(f"Warning: {sentence}")
    for sentence in imported.notes:
        print(f"Note: {sentence}")
    print(
        f"{settings.name}: {dataset.transitions:,} transitions in {dataset.episodes:,} episodes, "
        f"mean return {dataset.card.first_window_return_mean:.5g}; {shown(settings.folder)} has "
        f"them; read {shown(settings.folder / _REPORT)}. Next, for minutes: python -m "
        f"flows.full_benchmark profile=quick datasets=[{settings.name}]"
    )


if __name__ == "__main__":
    run_door("import_log", HELP, load_import_settings, import_log)
