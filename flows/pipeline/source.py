"""Which code made a result: the commit of this project, and a digest of the modules in question."""

import ast
import hashlib
import inspect
import os
import subprocess
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Final

__all__ = ["COMMIT", "code_digest", "commit"]

COMMIT: Final = "PROXIMITY_BENCH_COMMIT"
"""Environment variable: the commit of code that has come to a machine without its repository."""

CHANGED: Final = "+changes"
_CODE = ("components", "flows", "proximity_bench")
_ROOT = Path(__file__).resolve().parents[2]


@cache
def commit() -> str:
    """The commit of this code, with "+changes" behind it where files differ from it; or empty.

    Empty where the code lies in no repository of its own, as where it is installed.
    """
    if COMMIT in os.environ:
        return os.environ[COMMIT]
    try:
        # A repository around an installed copy is somebody else's, and does not track this file.
        _git("ls-files", "--error-unmatch", str(Path(__file__).resolve()))
        changed = _git("status", "--porcelain", "--", *_CODE)
        return _git("rev-parse", "HEAD") + (CHANGED if changed else "")
    except (OSError, subprocess.SubprocessError):
        return ""


def _git(*words: str) -> str:
    # Without optional locks: status would write to the index of a repository that is not ours.
    command = ["git", "--no-optional-locks", *words]
    found = subprocess.run(
        command, cwd=_ROOT, capture_output=True, text=True, timeout=10, check=True
    )
    return found.stdout.strip()


def code_digest(modules: Iterable[str]) -> str:
    """Digest of what modules do: of their code without comments, docstrings and layout.

    Args:
        modules: Names of imported modules.

    Returns:
        Python's version, whose parser is part of it, and 16 hexadecimal digits; empty where the
        source is not there.
    """
    try:
        code = "\n".join(_code(name) for name in sorted(set(modules)))
    except (OSError, TypeError):
        return ""
    digest = hashlib.sha256(code.encode()).hexdigest()[:16]
    return f"{sys.version_info.major}.{sys.version_info.minor}:{digest}"


@cache
def _code(module: str) -> str:
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [part for part in node.body if not _is_text(part)]
    return ast.dump(tree)


def _is_text(part: ast.stmt) -> bool:
    """Whether a statement is nothing but a text, as docstrings are."""
    return (
        isinstance(part, ast.Expr)
        and isinstance(part.value, ast.Constant)
        and isinstance(part.value.value, str)
    )
