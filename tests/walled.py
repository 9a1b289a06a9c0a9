"""Runs Python where only some packages can be imported, as on a computer without this project."""

import json
import subprocess
import sys
from pathlib import Path

_PRELUDE = """
import json, sys
allowed, refused = json.loads(sys.argv[1])

class Wall:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        inside = top in allowed or top in sys.stdlib_module_names if allowed else top not in refused
        if not inside:
            raise ModuleNotFoundError(f"There is no {name} here.", name=name)

sys.meta_path.insert(0, Wall())
sys.path.append(sys.argv[2])
sys.argv[:3] = ["-c"]
"""


def run_walled(
    code: str, *arguments: object, allowed: tuple[str, ...] = (), refused: tuple[str, ...] = ()
) -> str:
    """Run code in a process of its own, which sees neither this folder nor the site's start files.

    Args:
        code: Of Python.
        arguments: Its `sys.argv[1:]`.
        allowed: Packages beside Python's own that can be imported; empty: all but `refused`.
        refused: Packages that cannot.

    Returns:
        What it has printed.
    """
    site = next(path for path in sys.path if path.endswith("site-packages"))
    rule = json.dumps([allowed, refused])
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", _PRELUDE + code, rule, site, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(sys.executable).anchor,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
