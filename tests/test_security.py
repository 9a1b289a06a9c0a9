"""Nothing that a user hands in, or that lies in a store, can make this project run code of others.

The source is read: what unpickles, evaluates text or hands words to a shell is named here with its
line. Ray's own transport is the exception, see docs/security.md.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from components.core.arrays import load_arrays

ROOT = Path(__file__).parents[1]
ROOMS = ("benchmarks", "components", "docs", "examples", "flows", "proximity_bench")
UNPICKLERS = {"cloudpickle", "dill", "joblib", "jsonpickle", "marshal", "pickle", "shelve"}
CALLS = {
    "eval": "evaluates text",
    "exec": "runs text",
    "__import__": "imports by text",
    "os.system": "uses a shell",
    "os.popen": "uses a shell",
    "subprocess.getoutput": "uses a shell",
    "subprocess.getstatusoutput": "uses a shell",
    "torch.load": "unpickles; use safetensors",
    "pd.read_pickle": "unpickles",
    "pandas.read_pickle": "unpickles",
    "yaml.unsafe_load": "makes objects of any class",
    "yaml.full_load": "makes objects of many classes",
}
PLAIN_LOADERS = ("yaml.BaseLoader", "yaml.SafeLoader", "yaml.CSafeLoader")


def risks(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Lines of a program that could run code of others, and why."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names]
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else names
            for module in modules:
                if module.partition(".")[0] in UNPICKLERS:
                    yield node.lineno, f"imports {module}"
        elif isinstance(node, ast.Constant) and node.value in ("0.0.0.0", "::"):
            yield node.lineno, "listens to everybody"
        elif isinstance(node, ast.Call):
            yield from ((node.lineno, why) for why in _of_call(node))


def _of_call(call: ast.Call) -> Iterator[str]:
    name = ast.unparse(call.func)
    given = {word.arg: ast.unparse(word.value) for word in call.keywords if word.arg}
    own_text = len(call.args) == 1 and isinstance(call.args[0], ast.Constant)
    if name in CALLS and not (own_text and name == "exec"):
        yield f"{name} {CALLS[name]}"
    if given.get("shell", "False") != "False":
        yield f"{name} uses a shell"
    if name in ("np.load", "numpy.load") and given.get("allow_pickle") != "False":
        yield f"{name} without allow_pickle=False"
    if name == "yaml.load":
        loader = given.get("Loader") or (ast.unparse(call.args[1]) if len(call.args) > 1 else "")
        if loader not in PLAIN_LOADERS:
            yield f"yaml.load with {loader or 'no loader'}"


def test_no_line_of_the_source_runs_what_others_wrote() -> None:
    files = [file for room in ROOMS for file in sorted((ROOT / room).rglob("*.py"))]
    assert len(files) > 300, "the source is elsewhere"
    found = [
        f"{file.relative_to(ROOT)}:{line}: {why}"
        for file in files
        for line, why in risks(ast.parse(file.read_text(encoding="utf-8")))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from joblib import load",
        "eval(text)",
        "exec(text)",
        "os.system(command)",
        "subprocess.run(words, shell=True)",
        "torch.load(path)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "yaml.load(text, yaml.Loader)",
        "yaml.load(text)",
        "host = '0.0.0.0'",
    ],
)
def test_every_kind_of_risk_is_seen(line: str) -> None:
    assert list(risks(ast.parse(line)))


@pytest.mark.parametrize(
    "line",
    [
        "import json",
        "model.eval()",
        "exec('')",
        "subprocess.run(words)",
        "np.load(path, mmap_mode='r', allow_pickle=False)",
        "yaml.load(text, yaml.BaseLoader)",
        "host = '127.0.0.1'",
    ],
)
def test_what_is_harmless_is_left_alone(line: str) -> None:
    assert not list(risks(ast.parse(line)))


class Trap:
    """An object whose unpickling leaves a trace."""

    def __init__(self, trace: Path) -> None:
        self._trace = trace

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self._trace,)


def test_an_array_file_with_an_object_in_it_is_refused_unread(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    np.savez(tmp_path / "curves.npz", x=np.array([Trap(trace)], dtype=object))
    with pytest.raises(ValueError, match=r"curves\.npz"):
        load_arrays(tmp_path / "curves.npz")
    assert not trace.exists()
    with np.load(tmp_path / "curves.npz", allow_pickle=True) as unsafe:
        unsafe["x"]
    assert trace.exists(), "the trap does not work, so the test proves nothing"
