"""How the hot paths are measured, and the timing that all of them share."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.floors import Limits
from components.data.dataset import OfflineDataset
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.source import generate

__all__ = ["Settings"]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Of a run of all benchmarks.

    Attributes:
        device: Where learners, models and policies compute.
        threads: Of every process.
        seconds: Budget of the repeats of one row, together; a single slow call may exceed it.
        repetitions: Repeats.
        longest: Seconds that a row may be expected to take, up to five lanes twice as many; one
            beyond it is left out.
        everything: Measure 80 lanes also without a GPU, and leave nothing out.
        only_lanes: Numbers of lanes to measure instead of the usual ones.
        processes: That compute the same at the same time.
        quick: As small as it gets, for tests; the numbers mean nothing.
        peer: The Python of the peers' environment.
        matrix_rate: See :class:`.Limits`.
        bandwidth: Likewise.
    """

    device: str = "cpu"
    threads: int = 2
    seconds: float = 1.5
    repetitions: int = 3
    longest: float = 25.0
    everything: bool = False
    only_lanes: tuple[int, ...] = ()
    processes: int = 1
    quick: bool = False
    peer: str = ""
    matrix_rate: float = 0.0
    bandwidth: float = 0.0

    @property
    def place(self) -> torch.device:
        """The device."""
        return torch.device(self.device)

    @property
    def on_a_gpu(self) -> bool:
        """Whether it is a GPU."""
        return self.place.type == "cuda"

    @property
    def limits(self) -> Limits:
        """What the computer does at best."""
        return Limits(self.matrix_rate, self.bandwidth)

    @property
    def lanes(self) -> tuple[int, ...]:
        """Numbers of lanes to measure."""
        if self.only_lanes:
            return tuple(self.only_lanes)
        if self.quick:
            return (1,)
        return (1, 5, 20, 80) if self.on_a_gpu or self.everything else (1, 5, 20)

    def rate(self, component: str, kind: str, **details: object) -> dict[str, object]:
        """What projections must know of a row, beside its seconds, see `flows.planning.rates`."""
        what = {"component": component, "kind": kind, "device": self.place.type}
        return what | {"threads": self.threads, "processes": self.processes} | details

    def dataset(self) -> OfflineDataset:
        """The log that all of them read: `mediocre-0.2`, cut to 20 trajectories of 1,000 steps."""
        count = 2 if self.quick else 20
        return generate(IndustrialSpec("mediocre-0.2", "mediocre", 0.2, trajectories=count), seed=0)

    def settle(self) -> None:
        """Wait for the GPU, if one is used."""
        if self.on_a_gpu:
            torch.cuda.synchronize()

    def once(self, run: Callable[[], object]) -> float:
        """Seconds of one call."""
        begin = time.perf_counter()
        run()
        self.settle()
        return time.perf_counter() - begin

    def timings(self, run: Callable[[], object], warm: bool = False) -> list[float]:
        """Seconds per call, once for every repeat; a repeat is as many calls as the budget allows.

        Args:
            run: What to time.
            warm: Whether it has run before.
        """
        first = self.once(run)
        if not warm and first < self.seconds:
            first = self.once(run)
        calls = max(1, int(self.seconds / self.repetitions / max(first, 1e-9)))
        if warm and calls == 1:  # a slow one, of which the first call counts
            return [first, *(self.once(run) for _ in range(self.repetitions - 1))]

        def several() -> None:
            for _ in range(calls):
                run()

        return [self.once(several) / calls for _ in range(self.repetitions)]

    def peer_python(self) -> Path:
        """The Python of the peers' environment."""
        return Path(self.peer)
