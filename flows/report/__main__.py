"""The report of stored sweeps: ``python -m flows.report sweep=NAME``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator

from components.reporting.promises import brief
from flows.command_line import run_door
from flows.configuration.checking import SettingsError, StoreFolder, StrictModel, build_config
from flows.configuration.words import fields_of_words
from flows.pipeline.remote.bringing import bring
from flows.pipeline.remote.places import address_of
from flows.pipeline.store import ArtifactStore
from flows.report.gather import gather
from flows.report.judged import gather_judged, has_judgements
from flows.report.stored_nodes import has_cells, sweeps_of
from flows.report.written import write_files, write_judged

__all__ = ["ReportSettings", "load_report_settings", "report"]

HELP = """\
usage: python -m flows.report [KEY=VALUE ...]

Write the report of a sweep from its stored runs alone, in seconds, also while it is running: what
is not finished is a gap. Several sweeps stand beside each other. The page needs no network and no
other file. Of a log without a real system it shows what was judged from the log alone.

  sweep=NAME        of a sweep in the store, or sweep=[A,B]; may be left out if there is only one
  format=html       or markdown, latex
  figures=true      also every figure as SVG and PDF
  store=mlruns      folder of the runs
  out=FOLDER        where to write; STORE/reports/NAME by default
"""


def _names(given: Any) -> Any:
    if not isinstance(given, str):
        return given
    names = tuple(name.strip() for name in given.removeprefix("[").removesuffix("]").split(","))
    if not all(names) or len(set(names)) < len(names):
        raise SettingsError(f"sweep={given} must name sweeps, each once; e.g. sweep=[old,new].")
    return names


class ReportSettings(StrictModel):
    """What to report on, and how."""

    sweep: Annotated[tuple[str, ...], BeforeValidator(_names)] = ()
    format: Literal["html", "markdown", "latex"] = "html"
    figures: bool = False
    store: StoreFolder = Path("mlruns")
    out: Path | None = None


def load_report_settings(words: Sequence[str]) -> ReportSettings:
    """Settings from the command line.

    Raises:
        SettingsError: One sentence.
    """
    fields = fields_of_words(words, on_off=["figures"])
    settings: ReportSettings = build_config(ReportSettings, "", fields)
    if address_of(settings.store) is None and not (settings.store / "nodes").is_dir():
        raise SettingsError(
            f"store={settings.store} holds no runs; give the folder that a sweep has made."
        )
    return settings


def report(settings: ReportSettings) -> int:
    """Write the report and say where it is.

    Returns:
        The exit code.

    Raises:
        SettingsError: There is no such sweep, or nothing of it is finished.
        DamagedFileError: A file behind the report is missing or damaged.
    """
    bring(settings.store, settings.sweep)
    store = ArtifactStore(settings.store, create=False)
    names = settings.sweep or _only(store)
    folder = settings.out or settings.store / "reports" / "-and-".join(names)
    if not any(has_cells(store.root, name) for name in names) and any(
        has_judgements(store.root, name) for name in names
    ):
        return _judged(settings, store, names, folder)
    evidence = gather(store, names)
    files = write_files(folder, evidence, settings.format, figures=settings.figures)
    finished, missing = len(evidence.cells), len(evidence.gaps)
    print(f"{finished} of {finished + missing} cells of the table are finished.")
    _name(files)
    return 0


def _judged(
    settings: ReportSettings, store: ArtifactStore, names: Sequence[str], folder: Path
) -> int:
    """The report on sweeps whose policies were judged and never tried."""
    if settings.format == "latex":
        raise SettingsError(
            f"format=latex is a table of policies that were tried, and sweep={','.join(names)} has "
            "judged its policies from their logs alone; format=markdown has the tables of that."
        )
    judged = gather_judged(store, names)
    files = write_judged(folder, judged, settings.format)
    for log in judged.logs:
        for line in (*brief(log), *log.progress):
            print(line)
    if settings.figures:
        print("figures=true: judged policies have no figures but those of the page.")
    _name(files)
    return 0


def _name(files: Sequence[Path]) -> None:
    for file in files:
        print(f"{file} ({file.stat().st_size / 1e6:.1f} MB)")


def _only(store: ArtifactStore) -> tuple[str, ...]:
    """The only sweep with results to report.

    Raises:
        SettingsError: There is none, or there are several.
    """
    root = store.root
    names = [n for n in sweeps_of(root) if has_cells(root, n) or has_judgements(root, n)]
    if len(names) != 1:
        there = f"there are {', '.join(names)}" if names else _none(store)
        raise SettingsError(f"Name a sweep of {store.root}, e.g. sweep=NAME; {there}.")
    return tuple(names)


def _none(store: ArtifactStore) -> str:
    known = ", ".join(sweeps_of(store.root))
    return f"none of {known} evaluates or judges policies" if known else "it has none"


if __name__ == "__main__":
    run_door("report", HELP, load_report_settings, report)
