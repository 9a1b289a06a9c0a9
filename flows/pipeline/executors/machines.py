"""Whether every machine of a cluster can do the work: same code, same folder.

A machine with other code would compute other numbers, and one that does not see the store fails
every task in a second and so draws all of them to itself. Both are found before the work starts.
"""

import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from flows.pipeline.errors import PipelineError

__all__ = ["check_machines", "fault", "machine_probe"]

_PATIENCE = 60.0  # seconds in which every machine answers

Record = Mapping[str, Any]


def machine_probe() -> Callable[[str], dict[str, Any]]:
    """The function that describes a machine.

    It is made here, inside a function, so that it travels as code and runs where this package is
    missing or another one. It returns the code's folder, digest and version, the versions of
    Python and PyTorch, and whether the token, a file or the URL of an object, is seen and its
    folder can be written.
    """

    def describe(token: str) -> dict[str, Any]:
        import hashlib
        import importlib.metadata
        import importlib.util
        import os
        import platform
        import time
        from pathlib import Path

        def version(name: str) -> str:
            try:
                return importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                return "none"

        found: dict[str, Any] = {
            "host": platform.node(),
            "python": ".".join(platform.python_version_tuple()[:2]),
            "torch": version("torch").partition("+")[0],
            "version": os.environ.get("PROXIMITY_BENCH_VERSION") or version("proximity-bench"),
            "folder": "",
            "code": "",
        }
        code = hashlib.sha256()
        for package in ("flows", "components"):
            spec = importlib.util.find_spec(package)
            if spec is None or not spec.submodule_search_locations:
                break
            folder = Path(next(iter(spec.submodule_search_locations)))
            for file in sorted(folder.rglob("*.py")):
                code.update(f"{package}/{file.relative_to(folder).as_posix()}\n".encode())
                code.update(hashlib.sha256(file.read_bytes()).digest())
            found["folder"] = str(folder.parent)
        else:
            found["code"] = code.hexdigest()
        if "://" in token:
            found |= {"store": False, "writable": True, "why": "a package of fsspec is missing"}
            try:
                from flows.pipeline.errors import StoreError
                from flows.pipeline.remote.shared_store import SharedStore
            except ImportError:
                return found
            url, _, name = token.rpartition("/locks/")
            try:
                found["store"] = SharedStore(url).objects.read(f"locks/{name}") is not None
                found["why"] = "it is empty there"
            except (StoreError, ValueError) as error:
                found["why"] = str(error)
            return found
        deadline = time.monotonic() + 10.0  # a folder in the network may show a new file late
        while not Path(token).is_file() and time.monotonic() < deadline:
            time.sleep(0.2)
        found["store"] = Path(token).is_file()
        found["writable"] = os.access(Path(token).parent, os.W_OK)
        return found

    return describe


def fault(machine: str, theirs: Record | None, ours: Record, root: Path | str) -> str:
    """What is wrong with a machine, with the remedy, in one sentence; empty if nothing is.

    Args:
        machine: Its address.
        theirs: What the probe found there; None if it did not answer.
        ours: What it found here.
        root: Folder of the store, or its URL.
    """
    if theirs is None:
        return f"{machine} does not answer: repair it."
    if "error" in theirs:
        return f"{machine} cannot run a task ({theirs['error']}): repair it."
    if not theirs["code"]:
        return (
            f"{machine} does not find this package: install it there, or start Ray there in a "
            "project folder that all machines share."
        )
    for name, what in (("version", "proximity-bench"), ("python", "Python"), ("torch", "PyTorch")):
        if theirs[name] != ours[name]:
            return (
                f"{machine} has {what} {theirs[name]}, this computer has {ours[name]}: install the "
                "same there."
            )
    if theirs["code"] != ours["code"]:
        return (
            f"{machine} has other code in {theirs['folder']} than this computer in "
            f"{ours['folder']}: bring both to the same state, and start Ray there again."
        )
    if not theirs["store"] and theirs.get("why"):
        return f"{machine} cannot use the store ({theirs['why'].rstrip('.')})."
    if not theirs["store"]:
        return f"{machine} does not see the folder {root}: choose a store that all machines share."
    if not theirs["writable"]:
        return f"{machine} cannot write into the folder {root}: make it writable there."
    return ""


def check_machines(
    ray: Any, root: Path, url: str | None = None, patience: float = _PATIENCE
) -> None:
    """Asks every machine that may get work, all at once.

    Args:
        ray: The module, connected.
        root: Folder of the store.
        url: Of the shared store that it is a copy of, if it is one.
        patience: Seconds to wait for answers.

    Raises:
        PipelineError: machines that cannot do the work, each in one sentence.
    """
    pinned = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
    describe = machine_probe()
    nodes = [n for n in ray.nodes() if n["Alive"] and n["Resources"].get("CPU")]
    with _object(url) if url else _token(root) as token:
        asked = {}
        for node in nodes:
            strategy = pinned(node["NodeID"], soft=False)
            probe = ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=strategy)(describe)
            asked[probe.remote(token)] = node["NodeManagerAddress"]
        ray.wait(list(asked), num_returns=len(asked), timeout=patience)
        ours = describe(token)
        place = url or root
        found = (fault(machine, _answer(ray, it), ours, place) for it, machine in asked.items())
        wrong = sorted({sentence for sentence in found if sentence})
    if wrong:
        raise PipelineError(
            "Not every machine of the cluster can do the work; mend these or take them out of the "
            "cluster, and give the same command again. " + " ".join(wrong)
        )


def _answer(ray: Any, reference: Any) -> Record | None:
    try:
        answer: Record = ray.get(reference, timeout=0)
    except ray.exceptions.GetTimeoutError:
        return None
    except Exception as error:  # whatever keeps a machine from answering
        return {"error": (str(error).strip().splitlines() or [type(error).__name__])[-1]}
    return answer


@contextmanager
def _token(root: Path) -> Iterator[str]:
    """A file in the store that another machine can only see if it has the same folder."""
    path = root / "locks" / f".probe-{os.getpid()}-{secrets.token_hex(8)}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    try:
        yield str(path)
    finally:
        path.unlink(missing_ok=True)


@contextmanager
def _object(url: str) -> Iterator[str]:
    """An object in a shared store, by its URL."""
    from flows.pipeline.remote.objects import Objects

    objects, name = Objects(url), f"locks/.probe-{secrets.token_hex(8)}"
    objects.write(name, b"seen")
    try:
        yield f"{url}/{name}"
    finally:
        objects.delete([name])
