"""The code of this project as Ray takes it to machines that have none: a few packages, 4 MB.

What they need is installed there: Python, Ray and the dependencies, in the same versions.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from components.core.version import TRAVELLING, code_version
from flows.pipeline.source import COMMIT, commit

__all__ = ["PACKAGES", "code_environment"]

PACKAGES = ("components", "conf", "flows", "proximity_bench")


def code_environment(packages: Sequence[str] = PACKAGES) -> dict[str, Any]:
    """Ray's runtime environment for a job.

    Args:
        packages: Folders beside this package, or beside its installed copy.
    """
    root = Path(__file__).resolve().parents[3]
    # In the words of .gitignore: everything stays here but these folders. The first pattern leaves
    # out the root itself, which Ray calls ".".
    left_out = ["/[!.]*", "/.?*"]
    for package in packages:
        left_out += [f"!/{package}", f"!/{package}/**"]
    left_out.append("__pycache__")
    return {
        "working_dir": str(root),
        "excludes": left_out,
        "env_vars": {TRAVELLING: code_version(), COMMIT: commit()},
    }
