"""From the plant's log to a policy on the plant: ``python -m examples.furnace.run``.

Every step but the first and the last is a command of the project, printed before it runs. Nothing
is written outside of one folder. Nothing before the last step touches the plant.
"""

import argparse
import os
import shlex
import subprocess
import sys
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Final

import pandas as pd

from examples.furnace.compare import borne_out, chosen, comparison, comparison_figure
from examples.furnace.log import write_log
from examples.furnace.trial import operators_trial, policy_trials

__all__ = ["main"]

_SCHEMA: Final = Path(__file__).with_name("furnace.yaml")
_DRAFT: Final = "--describe"  # writes a draft of the schema to look at, and imports nothing
_PROXIMITIES: Final = tuple(n / 10 for n in range(11))  # those of the judges


@dataclass(frozen=True)
class _Sizes:
    """How much of everything."""

    shifts: int  # in the log
    rows: int  # of a shift
    tried: int  # shifts of the trial, for every policy and proximity
    algorithms: tuple[str, ...]
    seeds: tuple[int, ...]


_SIZES: Final = _Sizes(60, 300, 100, ("bc", "td3_bc", "lion"), (0, 1))
_BUDGETS: Final = (
    "profile=quick",
    "algorithm.lion.updates=150",
    "model.recurrent_ensemble.updates=1000",
    "model.recurrent_ensemble.learning_rate=0.01",
)
_SMALL_SIZES: Final = _Sizes(8, 100, 3, ("bc", "lion"), (0,))
_SMALL_BUDGETS: Final = (
    "profile=smoke",
    "model.recurrent_ensemble.warm_up=10",
    "model.recurrent_ensemble.horizon=10",
    "judging.estimates.updates=20",
    "ranking.stochasticity.updates=20",
    "runner.executor=serial",
    "runner.tracker=none",
)


def main() -> None:
    """Run all steps."""
    parser = argparse.ArgumentParser(prog="python -m examples.furnace.run", description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("furnace-example"), help="of all files")
    about = "kelvin by which operators change the set point at most"
    parser.add_argument("--boldness", type=float, default=25.0, help=about)
    parser.add_argument("--small", action="store_true", help="with next to no training, for tests")
    given = parser.parse_args()
    folder: Path = given.folder.absolute()
    if folder.exists() and any(folder.iterdir()):
        parser.error(f"{folder} is not empty; remove it or give another --folder.")
    folder.mkdir(parents=True, exist_ok=True)
    sizes, budgets = (_SMALL_SIZES, _SMALL_BUDGETS) if given.small else (_SIZES, _BUDGETS)

    log = folder / "furnace.csv"
    write_log(log, sizes.shifts, sizes.rows, given.boldness, seed=0)
    print(f"The plant's historian has written {log}.", flush=True)
    store = f"store={folder / 'mlruns'}"
    chosen = ("datasets=[furnace]", "sweep=furnace", store, *budgets)
    _command(folder, "import_log", log, "name=furnace", f"schema={folder / 'draft.yaml'}", _DRAFT)
    _command(folder, "import_log", log, "name=furnace", f"schema={_SCHEMA}")
    _command(folder, "rank_datasets", *chosen)
    algorithms, seeds = ",".join(sizes.algorithms), ",".join(map(str, sizes.seeds))
    _command(folder, "full_benchmark", *chosen, f"algorithms=[{algorithms}]", f"seeds=[{seeds}]")
    for algorithm, seed in product(sizes.algorithms, sizes.seeds):
        run, to = f"{algorithm}/furnace/seed{seed}", _exported(folder, algorithm, seed)
        _command(folder, "export_policy", f"run={run}", f"to={to}", store)
    _try_on_the_plant(folder, sizes, given.boldness)


def _command(folder: Path, door: str, *words: str | Path) -> None:
    """Run a command of the project, or end as it did."""
    command = [sys.executable, "-m", f"flows.{door}", *map(str, words)]
    print(f"\n$ {shlex.join(['python', *command[1:]])}", flush=True)
    done = subprocess.run(
        command, env=os.environ | {"PROXIMITY_BENCH_HOME": str(folder)}, check=False
    )
    if done.returncode:
        sys.exit(done.returncode)


def _exported(folder: Path, algorithm: str, seed: int) -> Path:
    return folder / "policies" / f"{algorithm}-{seed}.onnx"


def _try_on_the_plant(folder: Path, sizes: _Sizes, boldness: float) -> None:
    """Run everything on the plant and hold the judges to it."""
    operators = operators_trial(sizes.tried, sizes.rows, boldness)
    trials = pd.concat(
        [
            policy_trials(
                _exported(folder, algorithm, seed), _PROXIMITIES, sizes.tried, sizes.rows
            ).assign(algorithm=algorithm, seed=seed)
            for algorithm, seed in product(sizes.algorithms, sizes.seeds)
        ],
        ignore_index=True,
    )
    judgements = pd.read_csv(folder / "mlruns" / "reports" / "furnace" / "judgements.csv")
    joined = comparison(judgements, trials)
    joined.to_csv(folder / "comparison.csv", index=False)
    comparison_figure(joined, operators).savefig(folder / "comparison.png", dpi=110)
    shown = ["return", "euros_per_hour", "temperature", "ratio", "model", "fitted_q", "outside"]
    means = joined.groupby(["algorithm", "proximity"], dropna=False, sort=False)[shown].mean()
    print("\nOn the plant, means of the seeds, beside the estimates of the judges:\n")
    print(means.reset_index().round(2).to_string(index=False))
    print("\nThe operators on the same furnaces:")
    print(", ".join(f"{name} {value:.2f}" for name, value in operators.items()))
    print("\nSpearman's rank correlations of the estimates with the return on the plant:\n")
    print(borne_out(joined).round(2).to_string(index=False))
    print("\nWhat would have been chosen by each score of the judges:\n")
    print(chosen(joined).round(2).to_string(index=False))
    print(f"\nAll numbers and the figure: {folder / 'comparison.csv'}, comparison.png")


if __name__ == "__main__":
    main()
