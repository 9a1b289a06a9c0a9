"""Every command of README.md and docs/ is run, or, where it is marked as long, understood.

Commands stand in blocks of the language ``bash``. A comment that begins with ``long`` marks one
that takes too much time, or serves until Ctrl-C: its words go to the command's own parser alone.
All others run, in a project folder with the log of a furnace.
"""

import argparse
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import pytest
from matplotlib.figure import Figure

from components.data.imports import report
from flows import command_line
from flows import door as flows_door
from flows.configuration import composition, files, schema
from flows.import_log import import_log, load_import_settings
from tests.conftest import ROOT
from tests.flows.furnace import as_csv, furnace, write_schema

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = {"bash", "python", "yaml", "text", "json", "toml", "html"}
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
ACTIVATE = ".venv/bin/activate"
"""What `make` has set up."""
SERVERS = ("mkdocs", "mlflow", "optuna-dashboard")
"""Programs of other packages; they serve until Ctrl-C."""

# A module that other tests have imported runs anew, which is what `python -m` does.
pytestmark = pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")


class Command(NamedTuple):
    """A line of a block.

    Attributes:
        words: Of the command.
        long: Whether it is marked as too long for a test.
    """

    words: tuple[str, ...]
    long: bool


def blocks(text: str) -> list[tuple[str, str]]:
    """Language and content of every block of a page."""
    return re.findall(r"^ *```(\w*)\n(.*?)^ *```$", text, re.M | re.S)


def commands_in(text: str) -> list[Command]:
    """The commands of a page."""
    found = []
    for language, content in blocks(text):
        for line in content.replace("\\\n", " ").splitlines() if language == "bash" else ():
            words = shlex.split(line, comments=True)
            if words:
                found.append(Command(tuple(words), bool(re.search(r"# long\b", line))))
    return found


ALL = list(dict.fromkeys(c for p in PAGES for c in commands_in(p.read_text(encoding="utf-8"))))


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with an empty store and a log to import; no cluster, no server."""
    for name in ("RAY_ADDRESS", "MLFLOW_TRACKING_URI"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    for name in ("benchmarks", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "mlruns" / "nodes").mkdir(parents=True)
    Path("furnace.csv").write_text(as_csv(furnace()), encoding="utf-8")
    return tmp_path


@contextmanager
def settings_of_its_own(patch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let the working folder have its own conf/, into which a log is imported."""
    shutil.copytree(composition.CONF, "conf")
    with patch.context() as here:
        for module in (composition, files, schema):
            here.setattr(module, "CONF", Path("conf").absolute())
        here.setattr(report, "report_figure", lambda dataset: Figure((1, 1)))  # drawing is slow
        composition.base_layers.cache_clear()
        yield
    composition.base_layers.cache_clear()


def stop_after_parsing(patch: pytest.MonkeyPatch) -> None:
    """Let commands end with 0 once their words are understood."""

    def door(name: str, help_text: str, load: Any, body: Any, **more: Any) -> NoReturn:
        load(sys.argv[1:])
        sys.exit(0)

    parse = argparse.ArgumentParser.parse_args

    def parse_and_stop(*arguments: Any, **options: Any) -> NoReturn:
        parse(*arguments, **options)
        sys.exit(0)

    patch.setattr(command_line, "run_door", door)
    patch.setattr(flows_door, "run_door", door)
    patch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)


def run_module(module: str, words: Sequence[str], patch: pytest.MonkeyPatch) -> None:
    """Run ``python -m module`` in this process; it must end well."""
    patch.setattr(sys, "argv", [module, *words])
    code: Any = 0
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as ended:
        code = ended.code
    assert not code


def python_module(module: str, words: Sequence[str], long: bool, patch: pytest.MonkeyPatch) -> None:
    """Run a module or, if that takes long, its parser; with an imported log if it names one."""
    if long:
        path = ROOT.joinpath(*module.split("."))
        source = next(p for p in (path.with_suffix(".py"), path / "__main__.py") if p.is_file())
        text = source.read_text(encoding="utf-8")
        assert re.search(r'run_door\(|main\("|parse_args\(', text), f"{module} has no parser"
        stop_after_parsing(patch)
    if not any("furnace" in word for word in words):
        return run_module(module, words, patch)
    with settings_of_its_own(patch):
        if "--describe" not in words:
            write_schema(Path.cwd())
        if module != "flows.import_log":
            import_log(load_import_settings(["furnace.csv", "name=furnace"]))
            composition.base_layers.cache_clear()
        return run_module(module, words, patch)


def extras_of(requirement: str) -> set[str]:
    """The extras in a requirement such as ``.[docs]``."""
    found = re.search(r"\[(.*)\]", requirement)
    return set(found[1].split(",")) if found else set()


def perform(command: Command, patch: pytest.MonkeyPatch) -> None:
    """Run a command, or understand it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"]
    match command.words:
        case ("python", "-m", program, *_) | (program, *_) if program in SERVERS:
            needed = [*project["dependencies"], *optional["dashboard"], *optional["docs"]]
            assert any(re.match(rf"{program}\b", line) for line in needed)
            assert command.long
        case ("python", "-m", module, *words):
            python_module(module, words, command.long, patch)
        case ("make", target):
            assert target in TARGETS
            assert command.long  # tests run no tests, and install nothing
        case ("pip", "install", *words):
            assert extras_of(words[-1]) <= set(optional)
            assert command.long
        case ("source", script):
            assert script == ACTIVATE
        case ("export", assignment):
            assert re.fullmatch(r"[A-Z_]+=\S+", assignment)
        case _:
            pytest.fail(f"No test knows how to check the command {shlex.join(command.words)}.")


def test_every_block_says_what_it_is() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        languages = {language for language, _ in blocks(text)}
        assert languages <= LANGUAGES, f"{page.name}: commands stand in blocks of ```bash"
        indented = re.findall(r"^(?: {4}|\t)(?:python|make|pip) .*", text, re.M)
        assert indented == [], f"{page.name}: commands stand in blocks of ```bash"


@pytest.mark.parametrize("page", ["README.md", "docs/operations.md"])
def test_the_environment_is_activated_before_its_python_is_used(page: str) -> None:
    found = [command.words for command in commands_in((ROOT / page).read_text(encoding="utf-8"))]
    first = next(place for place, words in enumerate(found) if words[0] == "python")
    assert ("source", ACTIVATE) in found[:first]


def test_there_are_commands_of_both_kinds() -> None:
    assert len([c for c in ALL if not c.long]) > 5
    assert len([c for c in ALL if c.long]) > 5
    assert commands_in("```bash\nmake \\\n  test # long: 1 s\n# nothing\n```\n") == [
        Command(("make", "test"), True)
    ]


@pytest.mark.parametrize("command", ALL, ids=lambda command: shlex.join(command.words))
def test_a_command_runs_or_is_understood(
    command: Command, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    perform(command, monkeypatch)


@pytest.mark.parametrize(
    "line",
    [
        "python -m flows.full_benchmark profile=quick algorithm.lion.update=5 # long: 1 min",
        "python -m flows.full_benchmark datasets=[nowhere] dry_run=true",
        "python -m benchmarks.lanes --devices cuda # long: 1 min",
        "python -m flows.verify store=nowhere",
        "make tests # long: 1 min",
        "make test",
        "pip install '.[nothing]' # long: 1 min",
        "rm -r mlruns",
    ],
)
def test_a_wrong_command_is_noticed(
    line: str, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    [command] = commands_in(f"```bash\n{line}\n```\n")
    with pytest.raises((AssertionError, ValueError, pytest.fail.Exception)):
        perform(command, monkeypatch)


def test_commands_in_sentences_exist() -> None:
    for page in PAGES:
        prose = re.sub(r"^ *```.*?^ *```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        spans = re.findall(r"`([^`]+)`", prose)
        targets = [span.split()[1] for span in spans if re.match(r"make [a-z]", span)]
        assert set(targets) <= TARGETS, page.name
        modules = [span.split()[2] for span in spans if re.match(r"python -m [a-z]", span)]
        for module in set(modules) - {"flows.NAME"}:
            path = ROOT.joinpath(*module.split("."))
            assert path.with_suffix(".py").is_file() or path.is_dir(), f"{page.name}: {module}"


def lines_of_target(target: str) -> str:
    """What ``make`` would give to the shell for a target on a fresh machine."""
    command = ["make", "--no-print-directory", "--dry-run", "--always-make", target]
    return subprocess.run(command, cwd=ROOT, text=True, check=True, capture_output=True).stdout


@pytest.mark.parametrize("target", sorted(TARGETS))
def test_the_shell_understands_every_target(target: str) -> None:
    lines = lines_of_target(target)
    assert lines
    read = subprocess.run(["sh", "-n"], input=lines, text=True, check=False, capture_output=True)
    assert read.stderr == ""


def test_targets_install_extras_that_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for target, extras in (("console", set()), ("setup", {"dev", "export"})):
        [installed] = re.findall(r"--editable (\S+)", lines_of_target(target))
        assert extras_of(installed) == extras
        assert extras <= set(project["optional-dependencies"])
