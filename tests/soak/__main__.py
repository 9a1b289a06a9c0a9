"""Kills a small benchmark at random and says what became of it: ``make soak``.

First the sweep runs undisturbed. Then it is started, killed somewhere and somehow, and started
again, until it is finished; and as often anew as there are kills left. After every finished sweep
its store, its record in MLflow and what is left of its processes are checked.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from flows.configuration.settings import load_settings
from flows.pipeline.plan import Plan
from tests.flows.pipeline.toys import wait_for
from tests.soak.checks import compared, leftovers, recorded
from tests.soak.driver import soaked_plan
from tests.soak.processes import adopt_orphans, descendants, end_all, reap, shared_memory
from tests.soak.server import Server

GRID = (
    "profile=smoke",
    "datasets=[bad-0.4,mediocre-0.2]",
    "algorithms=[bc,td3_bc,lion]",
    "seeds=[0,1]",
    "algorithm.bc.updates=2000",
    "algorithm.td3_bc.updates=1500",
    "algorithm.lion.updates=60",
    "model.recurrent_ensemble.updates=100",
    "runner.cpus=2",
    "runner.device=cpu",
)
_LEAST_GAP = 4.0  # seconds between two kills on average, at least: about a driver's start
KINDS = ("driver", "worker", "raylet", "gcs", "server", "group", "SIGTERM", "Ctrl-C")
_PATIENCE = 120.0  # seconds in which a driver that was told to end, or has lost Ray, ends


class Soak:
    """One soak: the store of the present sweep, its driver and its server, and what was seen."""

    def __init__(self, home: Path, rng: random.Random, plan: Plan) -> None:
        self.home, self.rng, self.plan = home, rng, plan
        self.problems: list[str] = []
        self.kills = self.sweeps = self.lives = 0
        self.undisturbed = home / "undisturbed"
        self.store = home
        self.temporary = home / "t"
        self.temporary.mkdir()
        self.driver: subprocess.Popen[bytes] | None = None
        self.server: Server | None = None
        self.silent = 0  # ends of a driver in a row that nobody had killed
        self.memory = shared_memory()

    def start(self, *words: str) -> subprocess.Popen[bytes]:
        """Starts a driver in a session of its own, as a terminal would."""
        self.lives += 1
        address = {"MLFLOW_TRACKING_URI": self.server.address} if self.server else {}
        clean = {key: text for key, text in os.environ.items() if key != "RAY_ADDRESS"}
        command = [sys.executable, "-m", "tests.soak.driver", *GRID, f"store={self.store}", *words]
        with open(self.log, "wb") as log:
            return subprocess.Popen(
                command,
                env=clean | address | {"TMPDIR": str(self.temporary)},
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )

    @property
    def log(self) -> Path:
        """Where the present driver writes."""
        return self.home / f"driver-{self.lives}.log"

    def done(self) -> int:
        """Finished nodes of the present sweep."""
        nodes = self.store / "nodes"
        return len(list(nodes.iterdir())) if nodes.exists() else 0

    def first_run(self) -> float:
        """The undisturbed run; seconds until its first node was finished."""
        self.store = self.undisturbed
        begun = time.monotonic()
        self.driver = self.start("runner.tracker=none")
        wait_for(lambda: self.done() or self.driver.poll() is not None, "a first node")
        first = time.monotonic() - begun
        if self.driver.wait() != 0:
            raise RuntimeError(f"The undisturbed run failed:\n{self.log.read_text()}")
        say(f"undisturbed: {len(self.plan)} nodes in {time.monotonic() - begun:.0f} s")
        return first

    def begin_sweep(self) -> None:
        """A new store and a new server."""
        self.sweeps += 1
        self.store = self.home / f"sweep-{self.sweeps}"
        self.server = Server(self.home / f"server-{self.sweeps}")
        self.server.start()
        self.driver = self.start()

    def live(self, gap: float) -> bool:
        """Lets the driver run for a while and starts it again where it has ended.

        Returns:
            Whether it is there to be killed; otherwise the sweep is finished.
        """
        until = time.monotonic() + gap
        while time.monotonic() < until:
            with suppress(subprocess.TimeoutExpired):
                if self.driver.wait(timeout=max(0.0, until - time.monotonic())) == 0:
                    return False
                self.silent += 1
                if self.silent > 3:
                    raise RuntimeError(f"It ends by itself:\n{self.log.read_text()[-3000:]}")
                self.driver = self.start()
        return True

    def kill(self) -> None:
        """Kills something, says it, and has the driver alive again."""
        kind, found = self.rng.choice(KINDS), self.done()
        victims = self.victims(kind)
        if not victims:
            kind, victims = "driver", [self.driver.pid]
        victim = self.rng.choice(sorted(victims))
        self.kills += 1
        self.silent = 0
        at = f"{self.kills:4}  {time.monotonic() - BEGUN:5.0f} s  {kind:8}{victim:8}"
        say(f"{at}  {found} of {len(self.plan)} nodes finished")
        if kind == "server":
            self.server.kill()
            with suppress(subprocess.TimeoutExpired):
                self.driver.wait(timeout=self.rng.uniform(0.0, 5.0))
            self.server.start()
            return
        number = {"SIGTERM": signal.SIGTERM, "Ctrl-C": signal.SIGINT}.get(kind, signal.SIGKILL)
        with suppress(ProcessLookupError):
            if kind in ("group", "Ctrl-C"):
                os.killpg(victim, number)
            else:
                os.kill(victim, number)
        if kind == "worker":
            return
        self.see_end(kind)
        self.driver = self.start()

    def victims(self, kind: str) -> list[int]:
        """Processes of this kind."""
        ours = descendants(self.driver.pid)
        match kind:
            case "worker":
                return [p.pid for p in ours if p.name.startswith("ray::")]
            case "raylet":
                return [p.pid for p in ours if p.name.endswith("/raylet")]
            case "gcs":
                return [p.pid for p in ours if p.name.endswith("/gcs_server")]
            case "server":
                return sorted(self.server.pids)
        return [self.driver.pid]

    def see_end(self, kind: str) -> None:
        """Waits for the end of a driver and looks at how it ended."""
        try:
            code = self.driver.wait(timeout=_PATIENCE)
        except subprocess.TimeoutExpired:
            self.problem(f"{kind}: the driver did not end within {_PATIENCE:.0f} s")
            os.killpg(self.driver.pid, signal.SIGKILL)
            self.driver.wait()
            return
        text = self.log.read_text(errors="replace")
        allowed = {
            "SIGTERM": (0, 143, -signal.SIGTERM),
            "Ctrl-C": (0, 130, -signal.SIGINT),
            "raylet": (0, 1),
            "gcs": (0, 1),
        }.get(kind, (0, -signal.SIGKILL))
        if code not in allowed or ("Traceback" in text and "/flows/" in text):
            self.problem(f"{kind}: the driver ended with {code}:\n{text[-3000:]}")

    def problem(self, text: str) -> None:
        """Notes and shows something that must not be."""
        self.problems.append(text)
        say(f"      PROBLEM {text}")

    def finish_sweep(self) -> None:
        """Checks what a finished sweep has left."""
        found = compared(self.plan, self.undisturbed, self.store)
        try:
            wait_for(lambda: not self.others(), "the end of all processes", 60.0)
        except AssertionError:
            found.append(f"still alive: {self.others()}")
        found += leftovers(self.store, self.temporary)
        found += recorded(self.plan, self.server.address)
        self.server.kill()
        if memory := shared_memory() - self.memory:
            found.append(f"shared memory left: {sorted(memory)}")
        for text in found:
            self.problem(f"sweep {self.sweeps}: {text}")
        if not found:
            say(f"      sweep {self.sweeps} is finished, and as if it had not been disturbed")
            shutil.rmtree(self.store)
        self.driver = None

    def others(self) -> list[str]:
        """Descendants that should not be there when no driver runs."""
        known = self.server.pids if self.server else set()
        reap(known | ({self.driver.pid} if self.driver else set()))
        server = {p.pid for pid in known for p in descendants(pid)} | known
        return [f"{p.pid} {p.name}" for p in descendants() if p.pid not in server]


def say(text: str) -> None:
    """Prints a line at once."""
    print(text, flush=True)


BEGUN = time.monotonic()


def soak(kills: int, seed: int, minutes: float, home: Path) -> int:
    """Runs a soak; the exit code."""
    say(f"seed {seed}; {home}")
    adopt_orphans()
    plan = soaked_plan(load_settings(list(GRID)))
    run = Soak(home, random.Random(seed), plan)
    first = run.first_run()
    while run.kills < kills or run.driver is not None:
        if run.driver is None or run.server is None:
            run.begin_sweep()
        gap = 3600.0
        if run.kills < kills:
            # Starts and checks take their part of the time: the more, the closer kills follow.
            left = 60.0 * minutes - (time.monotonic() - BEGUN)
            mean = max(_LEAST_GAP, min(first, 0.8 * left / (kills - run.kills)))
            gap = run.rng.uniform(0.0, 2.0 * mean)
        if run.live(gap):
            run.kill()
        else:
            run.finish_sweep()
    end = f"{len(run.problems)} problems" if run.problems else "all as undisturbed, nothing left"
    say(
        f"Verdict: {run.kills} kills, {run.lives} starts, {run.sweeps} sweeps in "
        f"{(time.monotonic() - BEGUN) / 60:.0f} min, seed {seed}: {end}."
    )
    return 1 if run.problems else 0


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=None, help="of kills; drawn by default")
    parser.add_argument("--minutes", type=float, default=15.0, help="that kills are spread over")
    parser.add_argument("--keep", action="store_true", help="keep stores and logs")
    options = parser.parse_args()
    seed = random.SystemRandom().randrange(10**6) if options.seed is None else options.seed
    home = Path(tempfile.mkdtemp(prefix="soak-"))
    code = 1
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        code = soak(options.kills, seed, options.minutes, home)
    finally:
        end_all()
        if code == 0 and not options.keep:
            shutil.rmtree(home, ignore_errors=True)
        else:
            say(f"Stores and logs: {home}")
    return code


if __name__ == "__main__":
    sys.exit(main())
