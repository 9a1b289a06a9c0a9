"""A store that machines without a common disk share: the local store, and its twin behind a URL.

Everything is made, read and checked in this machine's copy, an ordinary store. Beyond that, a
finished artifact is pushed before it appears here, and what somebody needs is pulled, with its
digests. The twin is the truth: what is not there is not finished.

Locks hold on this machine by the kernel and between machines by claims of drivers, see `claims`.
"""

import dataclasses
import secrets
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from components.core.files import write_text
from components.core.integrity import DamagedFileError, describe_files
from components.core.sealed import manifest_digest
from flows.pipeline.driver import is_driven
from flows.pipeline.errors import PipelineError, StoreError
from flows.pipeline.locks import locked
from flows.pipeline.remote.courier import DriverCourier, WorkerCourier, sweep_claim
from flows.pipeline.remote.folders import Folder
from flows.pipeline.remote.places import address_of
from flows.pipeline.remote.shared_artifacts import SharedArtifacts
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import sweep_files
from flows.pipeline.work import Work

__all__ = ["SharedStore", "store_at"]

_SHARED = "shared:"  # begins the name of a folder that has travelled
_STAYS = ("ready.json", "out")  # of a work folder: half-made outputs


class SharedStore(SharedArtifacts):
    """The copy of a shared store on this machine, see :class:`SharedArtifacts`."""

    def __init__(
        self,
        url: str,
        owner: str = "",
        *,
        drives: bool = False,
        repairs: bool = True,
        root: Path | None = None,
    ) -> None:
        """Opens the store, and makes the folder of its copy here.

        Args:
            url: Of the shared store.
            owner: Whose claims are made; empty for a store to read.
            drives: Whether the driver of a sweep holds it.
            repairs: Whether what is damaged in the shared store is mended or taken away.
            root: Folder of the copy, if it is another one.

        Raises:
            StoreError: the folder cannot be made, or the protocol is not known.
        """
        super().__init__(url, owner, drives=drives, repairs=repairs, root=root)
        self._sent: dict[str, str] = {}
        self._groups: set[str] = set()  # of calls that were sent and have not come back
        self._begun: dict[str, Folder] | None = None  # lists of work, as a driver has found them

    def fetch(self, keys: Iterable[str]) -> None:
        """Brings artifacts here, see :meth:`SharedArtifacts.fetch`; others may have begun work."""
        self._begun = None
        super().fetch(keys)

    # Work folders

    def begin(self, keys: Collection[str]) -> None:
        """Brings checkpoints of these nodes here that are further than those here.

        Raises:
            StoreError: the shared store does not answer.
        """
        for name, listed in self._works().items():
            if not set(listed.get("serves", ())) & set(keys):
                continue
            here = self.work / name
            ours = next((w for w in super().work_folders() if w.path == here), None)
            reached = self.reached(ours) if ours is not None and ours.resumed else -1.0
            if float(listed.get("reached", 0.0)) > reached:
                self._folders.pull(f"work/{name}", listed, here)

    def save(self, work: Work) -> None:
        """Pushes the checkpoint of a work folder, if it has one.

        Raises:
            StoreError: the shared store does not answer or cannot be written.
        """
        about = {"members": list(work.members), "serves": sorted(work.serves)}
        about |= {"reached": self.reached(work)}
        with suppress(FileNotFoundError):  # the work is over
            self._folders.push(work.path, f"work/{work.path.name}", about, _STAYS)

    def work_folders(self) -> list[Work]:
        """The work folders here; for a driver, those of all machines."""
        if not self.drives:
            return super().work_folders()
        if self._begun is None:
            self._begun = self._works()
        found = []
        for name, listed in self._begun.items():
            members, serves = tuple(listed["members"]), frozenset(listed["serves"])
            found.append(Work(self.work / name, members, serves, True))
        return found

    def reached(self, work: Work) -> float:
        """The fraction that the checkpoint of a work folder holds."""
        if self.drives and self._begun is not None and work.path.name in self._begun:
            return float(self._begun[work.path.name].get("reached", 0.0))
        return super().reached(work)

    def repair(self) -> list[str]:
        """Removes work that is over; whoever continues other work mends it."""
        self._begun = None
        for work in self.work_folders() if self.drives else ():
            if not self.unfinished(work):
                self._folders.remove(f"work/{work.path.name}")
        return []

    def _discard(self, folder: Path) -> None:
        super()._discard(folder)
        self._folders.remove(f"work/{folder.name}")

    def _works(self) -> dict[str, Folder]:
        """The lists of all work folders of the shared store, by name."""
        names = [n for n in self.objects.sizes("work") if n.count("/") == 1 and n.endswith(".json")]
        found = {}
        for name, content in self.objects.read_many(names).items():
            listed = self._folders.list_of(content)
            if listed is not None and "serves" in listed and "members" in listed:
                found[name.removeprefix("work/").removesuffix(".json")] = listed
        return found

    # Between a driver and its workers

    def sent(self, call: Any) -> Any:
        """A group call as another machine can take it; folders outside the store travel, too.

        Raises:
            StoreError: the shared store does not answer or cannot be written.
        """
        self._groups.add(call.group)
        nodes = tuple(
            {**node, "folders": {role: self._send(path) for role, path in node["folders"].items()}}
            for node in call.nodes
        )
        return dataclasses.replace(call, url=self.url, owner=self._claims.owner, nodes=nodes)

    def _send(self, path: str) -> str:
        if path not in self._sent:
            name = manifest_digest(describe_files(Path(path)))
            if self.objects.read(f"folders/{name}.json") is None:
                self._folders.push(Path(path), f"folders/{name}")
            self._sent[path] = f"{_SHARED}{name}"
        return self._sent[path]

    def folder(self, named: str) -> Path:
        """A folder outside the store, as a group call names it.

        Raises:
            DamagedFileError: it has not arrived whole.
            StoreError: the shared store does not answer.
        """
        if not named.startswith(_SHARED):
            return Path(named)
        name = named.removeprefix(_SHARED)
        here = self.root / "folders" / name
        with locked(self.locks / f"arriving-{name}"):
            if not here.is_dir():
                listed = self._folders.list_of(self.objects.read(f"folders/{name}.json"))
                if listed is None or not self._folders.pull(f"folders/{name}", listed, here):
                    said = f"folders/{name} of {self.url} is missing or damaged"
                    raise DamagedFileError(said, here)
        return here

    @contextmanager
    def carrying(self, group: str, work: Work) -> Iterator[None]:
        """Carries a running call's progress, checkpoints and requests to stop to and fro."""
        with WorkerCourier(self.objects, self, group, work.path, lambda: self.save(work)):
            yield

    def forget_requests(self, group: str) -> None:
        """Removes what was asked of an earlier call of this name on this machine."""
        super().clear_progress(group)

    def clear_progress(self, group: str) -> None:
        """Removes a call's report and requests, see :meth:`ArtifactStore.clear_progress`."""
        super().clear_progress(group)
        if self.drives:
            self._groups.discard(group)  # first: a look must not send an old request again
            ends = ("json", "stop", "pause")
            self.objects.delete(f"progress/{group}.{end}" for end in ends)

    @contextmanager
    def driven(self, name: str) -> Iterator[None]:
        """Drives a sweep for the length of a `with` block, which no other machine does meanwhile.

        Raises:
            PipelineError: another one does.
            StoreError: the shared store does not answer or cannot be written.
        """
        sweep = sweep_claim(name)
        self._claims.beat()
        try:
            with DriverCourier(self.objects, self, name, self._claims, self._groups) as courier:
                if not self._claims.outlive(sweep):
                    raise PipelineError(
                        f"Another process is running the sweep {name!r} in {self.url} "
                        f"({self._claims.holder(sweep)}): wait for it, stop it, or give this sweep "
                        "another name."
                    )
                courier.begin()
                self._mends = True
                self.fetch(self._doubtful)
                try:
                    yield
                finally:
                    with suppress(StoreError, OSError):
                        for group in sorted(self._groups):  # of calls that have not come back
                            self.clear_progress(group)
                        self.push_files(f"reports/{name}", f"tracking/{name}.jsonl")
        finally:
            with suppress(StoreError):
                self._claims.end()

    # For people

    def look_again(self) -> None:
        """Brings the records of sweeps and drivers here, in place of older ones.

        What a driver on this machine writes here stays: it is newer, and is sent from here.

        Raises:
            StoreError: the shared store does not answer.
        """

        def elsewhere(sweep: str) -> bool:
            return not is_driven(self.root, sweep)

        for folder in ("sweeps", "drivers"):
            self._bring_files(folder, elsewhere)
        if all(elsewhere(file.stem) for file in sweep_files(self.root)):
            self._bring_files("progress")

    def _bring_files(self, folder: str, wanted: Callable[[str], bool] = lambda name: True) -> None:
        names = [n for n in self.objects.sizes(folder) if n.endswith(".json")]
        for name, content in self.objects.read_many(names).items():
            path = self.root / name
            if wanted(path.stem):
                path.parent.mkdir(parents=True, exist_ok=True)
                write_text(path, content.decode(errors="replace"))

    def send_request(self, sweep: str) -> None:
        """Sends a request to the driver of a sweep to stop.

        Raises:
            StoreError: the shared store does not answer or cannot be written.
        """
        request = self.root / "drivers" / f"{sweep}.stop"
        with suppress(FileNotFoundError):
            self.objects.write(f"drivers/{request.name}", request.read_bytes())
            request.unlink()

    def push_files(self, *places: str) -> None:
        """Copies files of the store, such as those of a report, into the shared one.

        Args:
            places: Files, or folders whose files are meant, relative to the store.

        Raises:
            StoreError: the shared store does not answer or cannot be written.
        """
        tops = [self.root / place for place in places]
        found = (path for top in tops for path in (top, *sorted(top.rglob("*"))))
        files = {p.relative_to(self.root).as_posix(): p for p in found if p.is_file()}
        self.objects.upload(files)


def store_at(
    folder: Path, *, create: bool = True, drives: bool = False, repairs: bool = True
) -> ArtifactStore:
    """The store of a folder, which may be the copy of a shared one.

    Args:
        folder: The folder.
        create: Whether to make the folders; those of a copy are always made.
        drives: Whether to drive a sweep in it.
        repairs: Whether what is damaged in a shared store is mended or taken away.

    Raises:
        StoreError: it cannot be made or written.
    """
    url = address_of(folder)
    if url is None:
        return ArtifactStore(folder, create=create)
    owner = secrets.token_hex(8) if drives else ""
    return SharedStore(url, owner, drives=drives, repairs=repairs)
