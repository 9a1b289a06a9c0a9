"""An executor on Ray: on this computer, or on the cluster that RAY_ADDRESS names.

Ray is only asked to start a function in another process and to say when it ended. Whether a group
is started again after its worker died is decided here, so that it can be counted, shown and
limited: Ray's own retries are silent, and those after lack of memory never end. A death counts
against a group only while Ray itself lives.
"""

import contextlib
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from flows.pipeline.errors import PipelineError
from flows.pipeline.executors.cluster import Cluster, check_address
from flows.pipeline.executors.code import PACKAGES, code_environment
from flows.pipeline.executors.local_ray import LocalRay, set_environment
from flows.pipeline.executors.machines import check_machines
from flows.pipeline.executors.preflight import check_admission
from flows.pipeline.executors.processors import available_cpus, check_threads
from flows.pipeline.group import GroupCall, GroupResult
from flows.pipeline.signals import deferred_signals
from flows.pipeline.worker import run_group

__all__ = ["RayExecutor"]


class RayExecutor:
    """Runs groups as Ray tasks: on this computer, or on the cluster that RAY_ADDRESS names."""

    def __init__(
        self,
        *,
        cpus: int | None = None,
        threads: int = 1,
        device: str = "cpu",
        gpus: int = 1,
        gpus_per_task: float = 0.5,
        retries: int = 3,
        root: Path | None = None,
        url: str | None = None,
        precision: str = "highest",
        packages: Sequence[str] = PACKAGES,
    ) -> None:
        """Describes the cluster; nothing starts before `start`.

        Args:
            cpus: Processors to use on this computer; all by default. A cluster knows its own.
            threads: Threads, and therefore processors, of one group.
            device: "cpu" or "cuda".
            gpus: GPUs of this computer, if the device is "cuda". A cluster knows its own.
            gpus_per_task: Share of a GPU that one group occupies if the device is "cuda".
            retries: How often a group is started again after its worker died.
            root: Folder of the store; every machine of a cluster is asked whether it sees it.
            url: Of a store that machines of a cluster share instead of a folder; they need not have
                the code either, which travels with the job.
            precision: Of a GPU's products of float32.
            packages: What travels.

        Raises:
            PipelineError: a task would take more processors than there are.
        """
        self.threads = threads
        self.device = device
        self.precision = precision
        self._cpus = cpus or available_cpus()
        self._address = os.environ.get("RAY_ADDRESS")
        if not self._address:
            check_threads(threads, self._cpus)
        self._gpus = gpus_per_task if device == "cuda" else 0.0
        self.slots = max(1, _places(self._cpus, threads, gpus, self._gpus))
        self._retries = retries
        self._root, self._url, self._packages = root, url, packages
        self._ray: Any = None
        self._place: LocalRay | Cluster | None = None
        self._running: dict[Any, tuple[GroupCall, int]] = {}
        self._notify: Callable[[str], None] = lambda text: None

    def start(
        self, notify: Callable[[str], None], watch: Callable[[], None] = lambda: None
    ) -> None:
        """Starts Ray on this computer or connects to the cluster.

        Nothing calls `watch`: the work goes on in other processes while `wait` returns.

        Raises:
            PipelineError: Ray cannot be started or reached, has too few processors, or a machine
                of the cluster cannot do the work.
        """
        self._notify = notify
        address = self._address
        set_environment(local=not address)
        if address:
            check_address(address)
        import ray  # reads its environment at import, and costs a second

        place: Cluster | LocalRay
        if address:
            check_admission(ray, address)
            place = Cluster(address)
            if self._url:
                place.options["runtime_env"] = code_environment(self._packages)
        else:
            place = LocalRay(self._cpus)
        self._place = place
        # An interrupt in the middle of Ray's start has crashed in native code.
        with deferred_signals():
            self._ray = ray
            _silence(ray)
            try:
                ray.init(log_to_driver=False, logging_level=logging.ERROR, **place.options)
            except Exception as error:
                where = "Ray on this computer"
                if address:
                    where = f"the cluster at RAY_ADDRESS={address}"
                raise PipelineError(
                    f"Could not reach {where} ({_first_line(error)}): "
                    "start it, unset RAY_ADDRESS, or set runner.executor=serial."
                ) from error
        if address:
            resources = ray.cluster_resources()
            biggest = max(int(n["Resources"].get("CPU", 0)) for n in ray.nodes() if n["Alive"])
            check_threads(self.threads, biggest)
            cpus, gpus = (int(resources.get(name, 0)) for name in ("CPU", "GPU"))
            self.slots = _places(cpus, self.threads, gpus, self._gpus)
            if self._root is not None:
                check_machines(ray, self._root, self._url)
        if self.slots < 1 or (self._gpus and not ray.cluster_resources().get("GPU")):
            raise PipelineError(
                f"Ray offers no place for a task with {self.threads} processors on "
                f"{self.device!r}: lower runner.threads or change runner.device."
            )
        self._remote = ray.remote(num_cpus=self.threads, num_gpus=self._gpus, max_retries=0)(
            run_group
        )

    def submit(self, call: GroupCall) -> None:
        """Hands a group to Ray."""
        self._begin(call, 0)

    def _begin(self, call: GroupCall, deaths: int) -> None:
        try:
            reference = self._remote.options(name=call.title).remote(call)
        except self._ray.exceptions.RayError as error:
            raise _gone(_first_line(error)) from error
        self._running[reference] = call, deaths

    def wait(self, timeout: float) -> list[GroupResult]:
        """Groups that ended; those whose worker died are started again instead.

        Raises:
            PipelineError: Ray is gone.
        """
        if not self._running:
            return []
        self._check_ray()
        try:
            ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=timeout)
            if ready:
                everything = list(self._running)
                ready, _ = self._ray.wait(everything, num_returns=len(everything), timeout=0)
        except self._ray.exceptions.RayError as error:
            raise _gone(_first_line(error)) from error
        results = []
        for reference in ready:
            call, deaths = self._running.pop(reference)
            result = self._take(reference, call, deaths)
            if result is not None:
                results.append(result)
        return results

    def _take(self, reference: Any, call: GroupCall, deaths: int) -> GroupResult | None:
        exceptions = self._ray.exceptions
        try:
            result: GroupResult = self._ray.get(reference)
            return result
        except exceptions.RayTaskError as error:
            # Raised outside `run_group`: for example, the worker cannot import this package.
            return _lost(call, str(error))
        except exceptions.TaskCancelledError:
            raise KeyboardInterrupt from None
        except exceptions.RayError as error:
            self._check_ray(patience=0.5)
            if isinstance(error, exceptions.NodeDiedError | exceptions.LocalRayletDiedError):
                if isinstance(self._place, LocalRay):
                    raise _gone(_first_line(error)) from error
                self._notify(f"The machine of {call.title} is gone; starting again elsewhere.")
                self._begin(call, deaths)
                return None
            memory = isinstance(error, exceptions.OutOfMemoryError)
            why = "ran out of memory" if memory else "died"
            if deaths < (1 if memory else self._retries):
                self._notify(
                    f"The worker of {call.title} {why}; starting again from the checkpoint."
                )
                self._begin(call, deaths + 1)
                return None
            if memory and len(call.nodes) > 1:
                return GroupResult(call.group, too_many=[node["key"] for node in call.nodes])
            remedy = (
                "lower runner.cpus, so that fewer tasks run at once, or the batch"
                if memory
                else "see why (killed, or a crash in native code?) and give the same command again"
            )
            return _lost(
                call,
                f"{_first_line(error)}\n"
                f"The worker of {call.title} {why} {deaths + 1} times: {remedy}.",
            )

    def _check_ray(self, patience: float = 0.0) -> None:
        why = self._place.lost(self._ray, patience) if self._place else ""
        if why:
            raise _gone(why)

    def stop(self) -> None:
        """Interrupts running tasks and leaves Ray."""
        ray, place = self._ray, self._place
        if place is None:
            return
        self._ray = self._place = None
        if ray is not None:
            if place.lost(ray):
                place.kill(ray)
            else:
                self._interrupt(ray)
            ray.shutdown()
        self._running.clear()
        place.close()

    def _interrupt(self, ray: Any) -> None:
        for reference in self._running:
            with contextlib.suppress(Exception):
                ray.cancel(reference)
        if self._running:
            with contextlib.suppress(Exception):
                ray.wait(list(self._running), num_returns=len(self._running), timeout=2)


def _gone(why: str) -> PipelineError:
    return PipelineError(f"Ray is gone ({why}): give the same command again to continue.")


def _places(cpus: int, threads: int, gpus: int, share: float) -> int:
    """Groups that run at once, each on ``threads`` processors and a ``share`` of one GPU, if any.

    A share does not reach across GPUs: two of them at 0.4 hold four groups.
    """
    places = cpus // threads
    return min(places, gpus * int(1 / share)) if share else places


def _lost(call: GroupCall, reason: str) -> GroupResult:
    return GroupResult(call.group, failed={node["key"]: reason for node in call.nodes})


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__).rstrip(".")


def _silence(ray: Any) -> None:
    # Deaths of workers are announced in a block of text on stdout that no option turns off; we
    # report them ourselves. Should Ray rename the function, the text comes back, nothing else.
    module = ray._private.worker
    if hasattr(module, "print_to_stdstream"):
        module.print_to_stdstream = lambda *args, **kwargs: None
    # Ray's own handler of SIGTERM ends the process in native code; the signal is ours.
    if hasattr(ray._private.utils, "set_sigterm_handler"):
        ray._private.utils.set_sigterm_handler = lambda handler: None
