"""What all doors share: settings from the command line, store, tracker, errors in one sentence."""

import os
import shlex
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import torch
from rich.console import Console
from rich.markup import escape

from flows.configuration.settings import ALIASES, Settings, SettingsError, load_settings
from flows.configuration.shown import settings_yaml
from flows.door import run_door
from flows.pipeline.audit import audit
from flows.pipeline.driver import driving
from flows.pipeline.executors.executor import Executor
from flows.pipeline.executors.processors import available_cpus, check_threads
from flows.pipeline.executors.ray import RayExecutor
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.failures import failure_line
from flows.pipeline.leftovers import store_in_use
from flows.pipeline.limits import Limit
from flows.pipeline.plan import Plan
from flows.pipeline.progress import Display, duration
from flows.pipeline.remote.places import address_of
from flows.pipeline.remote.shared_store import store_at
from flows.pipeline.runner import Outcome, run_plan
from flows.pipeline.schedule import form_groups
from flows.pipeline.signals import ignored_signals
from flows.pipeline.sweep_records import SweepRecord
from flows.pipeline.tracking.board import Board
from flows.pipeline.tracking.board_tracker import BoardTracker
from flows.pipeline.tracking.file_tracker import FileTracker
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.tracker import Metrics, NullTracker, Tracker
from flows.planning.memory import check_capacity, needs, total_memory
from flows.planning.packing import chosen_device

__all__ = [
    "COMMON_HELP",
    "Metrics",
    "ReportWriter",
    "check_store",
    "command_words",
    "main",
    "make_executor",
    "make_tracker",
    "run_door",
    "run_sweep",
    "show_or_do",
    "store_word",
    "window_width",
]

COMMON_HELP = """\
  dry_run=true                    show the plan and stop
  show_settings=true              print every setting as YAML and stop
  yes=true                        also start what is estimated to take longer than a year
  sweep=NAME                      name of the sweep in the tracker and in STORE/reports
  max_hours=8                     stop cleanly after so many hours; the same command goes on
  until=07:00                     likewise at this time of day
  store=mlruns                    folder of everything that is kept, or its URL, e.g.
                                  s3://bucket/prefix: machines need no common disk then
  runner.executor=ray             or serial: everything in this process, for debugging
  runner.tracker=mlflow           or file: JSON lines in STORE/tracking; or none
  runner.cpus=2                   processors to use; all by default
  runner.threads=1                threads of a task
  runner.device=auto              or cpu, cuda; auto takes a GPU where there is one
  runner.gpu_share=0.5            share of a GPU that a task takes
  runner.precision=high           or highest, medium: of a GPU's products; high allows TF32
  repair=recompute                what is damaged in the store is made again; or refuse: stop there

Every other setting that show_settings=true prints is given the same way, as KEY.KEY=VALUE, except
those below `dataset`, which stand in conf/dataset.
"""
"""The end of the help of every door that runs nodes."""

_YEAR = 365 * 24 * 3600.0  # seconds; nobody waits so long by intention

ReportWriter = Callable[[Outcome], tuple[Sequence[Path], Metrics]]


def main(
    door: str,
    help_text: str,
    body: Callable[[Settings], int],
    aliases: Mapping[str, str] = ALIASES,
) -> None:
    """Run the door of a sweep with checked settings, or show them, and exit, see `run_door`.

    Args:
        door: Its name.
        help_text: Its help.
        body: Its work.
        aliases: Short keys of its command line and the full keys they stand for.
    """

    run_door(
        door,
        help_text,
        lambda words: load_settings(words, aliases),
        lambda settings: show_or_do(settings, body),
        resumes=True,
    )


def show_or_do(settings: Settings, body: Callable[[Settings], int]) -> int:
    """Print the settings if that is wanted, else do the work of a door; returns its exit code."""
    for note in settings.notes:
        print(f"Note: {note}", file=sys.stderr)
    if settings.show_settings:
        print(settings_yaml(settings), end="")
        return 0
    check_store(settings.store)
    return body(settings)


def make_executor(settings: Settings) -> Executor:
    """The executor that `runner` asks for.

    Raises:
        ValueError: There is no such device here.
        PipelineError: A task would take more processors than there are.
    """
    runner, device = settings.runner, chosen_device(settings)
    if runner.executor == "serial":
        check_threads(runner.threads, min(available_cpus(), runner.cpus or available_cpus()))
        return SerialExecutor(device=device, threads=runner.threads, precision=runner.precision)
    return RayExecutor(
        cpus=runner.cpus,
        threads=runner.threads,
        device=device,
        gpus=torch.cuda.device_count() if device == "cuda" else 0,
        gpus_per_task=runner.gpu_share,
        root=settings.store.absolute(),
        url=address_of(settings.store),
        precision=runner.precision,
    )


def make_tracker(settings: Settings) -> Tracker:
    """The tracker that `runner.tracker` names.

    Raises:
        TrackingError: MLflow cannot be used.
    """
    match settings.runner.tracker:
        case "mlflow":
            return MlflowTracker(settings.store, source=command_words()[1])
        case "file":
            return FileTracker(settings.store)
        case "none":
            return NullTracker()


def run_sweep(
    settings: Settings,
    name: str,
    plan: Plan,
    report: ReportWriter,
    params: Mapping[str, str] | None = None,
    about: str = "",
    board: Board | None = None,
) -> int:
    """Show the plan, run what is not finished, record and report it.

    Args:
        settings: Store, runner and selection.
        name: Of the sweep.
        plan: The nodes to compute.
        report: Called at the end, also of a partial sweep; returns the files and metrics to keep
            with the sweep.
        params: What the sweep is over; datasets, algorithms and seeds by default.
        about: What the plan is, in a sentence; shown before it.
        board: Says the rows of the leaderboard; None for a sweep without results.

    Returns:
        The exit code.

    Raises:
        SettingsError: This computer cannot do it, or it takes longer than a year.
    """
    limit = Limit(settings.runner.max_hours, settings.runner.until)
    repairs, drives = settings.runner.repair == "recompute", not settings.dry_run
    store = store_at(settings.store, create=drives, drives=drives, repairs=repairs)
    # A dry run prints its result, so it goes to stdout.
    display = Display(Console(highlight=False, soft_wrap=True) if settings.dry_run else None)
    executor = make_executor(settings)
    place = escape(store_word(settings))  # unbroken, to be copied
    display.console.print(f"Sweep [bold]{name}[/bold] in {place}/", soft_wrap=True)
    for sentence in filter(None, (about, limit.sentence)):
        display.note(sentence)
    found = audit(plan, store)
    if not repairs:
        found.refuse()
    seconds = display.show_plan(plan, store, executor.slots, found, executor.device)
    pending = form_groups(plan, (n.key for n in plan if n.key not in found.finished), store)
    if not os.environ.get("RAY_ADDRESS"):  # a cluster's computers may be larger
        memory = total_memory(executor.device)
        check_capacity(pending, memory, settings.store)
        if pending:
            display.note(needs(pending, memory, settings.store))
    if seconds > _YEAR and not settings.yes:
        raise SettingsError(
            f"This is estimated to take {duration(seconds)}; choose less, or add yes=true."
        )
    if settings.dry_run:
        for line in found.lines():
            display.note(line)
        return 0
    command = shlex.join(["python", *command_words()])
    tracker = make_tracker(settings)
    if board is not None:
        tracker = BoardTracker(tracker, board)
    tags = {
        "profile": settings.profile_name,
        "command": command,
        "mlflow.note.content": f"Sweep **{name}**, made by `{command}`. The table and the figures "
        "are among the artifacts, under `report/`; every node is a run below this one.",
    }
    if params is None:
        params = {
            "datasets": ",".join(settings.datasets),
            "algorithms": ",".join(settings.algorithms),
            "seeds": ",".join(map(str, settings.seeds)),
        }
    status = "FAILED"
    files: Sequence[Path] = ()
    metrics: Metrics = {}
    with store_in_use(store), store.driven(name), ExitStack() as told:
        try:
            tracker.open(name, tags, params, plan)
            driver = told.enter_context(driving(store, name, command, limit.reached, str(limit)))
            SweepRecord.of(name, command, plan).save(store.root)
            outcome = run_plan(
                plan,
                store,
                tracker,
                display,
                executor=executor,
                command=command,
                repairs=repairs,
                driver=driver,
                found=found,
            )
            driver.status = outcome.status
            if outcome.may_take_time:
                files, metrics = report(outcome)
            status = outcome.status
        except KeyboardInterrupt:
            status = "KILLED"
            raise
        finally:
            with ignored_signals():
                tracker.close(status, files, metrics)
    _name_missing(display, plan, outcome)
    return outcome.exit_code


def check_store(folder: Path) -> None:
    """Refuse a store that cannot be written, without writing.

    Raises:
        SettingsError: A file lies where a folder should be, or a folder may not be written.
    """
    try:
        nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    except OSError as error:
        raise SettingsError(f"store={folder} cannot be used: {error.strerror}.") from error
    if not nearest.is_dir():
        raise SettingsError(f"store={folder}: {nearest} is a file; name a folder.")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise SettingsError(
            f"store={folder}: {nearest} may not be written; name a folder that may."
        )


def store_word(settings: Settings) -> str:
    """What store= was given."""
    return address_of(settings.store) or str(settings.store)


def command_words() -> list[str]:
    """The command line behind ``python``."""
    module = getattr(sys.modules["__main__"], "__spec__", None)
    return ["-m", module.name if module else sys.argv[0], *sys.argv[1:]]


def window_width() -> int:
    """Characters in a line of the terminal; where there is none, lines are as long as they are."""
    return shutil.get_terminal_size(fallback=(10_000, 0)).columns


def _name_missing(display: Display, plan: Plan, outcome: Outcome) -> None:
    """List what is missing and why."""
    for key, reason in outcome.failed.items():
        display.note(f"missing {plan[key].name}: {failure_line(reason)}")
    for key, because in outcome.skipped.items():
        display.note(f"missing {plan[key].name}: needs {plan[because].name}, which failed")
    if outcome.unrecorded:
        display.note(outcome.unrecorded)
