"""Ctrl-C in a command that has not begun yet: real processes, interrupted at an import."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

# Presses Ctrl-C when the process comes to this import.
_SITE = """
import os, signal, sys

class Pressed:
    def find_spec(name, path=None, target=None):
        if name == "components":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Pressed)
"""


@pytest.mark.parametrize("door", ["full_benchmark", "status", "verify", "import_log"])
def test_an_interrupt_while_a_command_imports_leaves_no_traceback(
    door: str, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(_SITE, encoding="utf-8")
    paths = os.pathsep.join([str(tmp_path), os.getcwd()])
    done = subprocess.run(
        [sys.executable, "-m", f"flows.{door}"],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
        # A shell's background jobs ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert done.returncode == 128 + signal.SIGINT
    assert done.stderr == "\nInterrupted before anything had begun.\n"
    assert done.stdout == ""


@pytest.mark.parametrize("resumes", [True, False])
def test_the_exit_code_does_not_depend_on_where_a_command_was_interrupted(
    tmp_path: Path, resumes: bool
) -> None:
    """CPython itself would end with SIGINT after an interrupt inside code made from a text."""
    (tmp_path / "here.py").write_text(
        "import signal\n"
        "from flows.door import run_door\n"
        "def body(words): exec('signal.raise_signal(signal.SIGTERM)')\n"
        f"run_door('here', '', list, body, resumes={resumes})\n",
        encoding="utf-8",
    )
    done = subprocess.run(
        [sys.executable, "-m", "here"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.getcwd()])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 128 + signal.SIGTERM
    more = "; give the same command again to continue" if resumes else ""
    assert done.stderr == f"here: interrupted{more}.\n", "said where something continues"
