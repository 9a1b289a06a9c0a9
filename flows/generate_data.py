"""Datasets alone: ``python -m flows.generate_data datasets=[mediocre-0.2]``; all by default.

Every dataset is also exported in Minari's HDF5 format below ``mlruns/minari``, so that other tools
can load it: ``MINARI_DATASETS_PATH=mlruns/minari python -c "import minari; ..."``. An export holds
its own digest, so that the same command again changes nothing and mends what is damaged.
"""

from pathlib import Path

from components.data.dataset import OfflineDataset
from components.data.sources.minari_exchange import export_minari, remove_leftovers
from flows.command_line import COMMON_HELP, Metrics, main, run_sweep
from flows.configuration.settings import Settings
from flows.pipeline.locks import locked
from flows.pipeline.runner import Outcome
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import data_plan, sweep_name

HELP = f"""\
usage: python -m flows.generate_data [KEY=VALUE ...]

Generate datasets and export them for Minari, into mlruns/minari. Minari's id follows from the
name: mediocre-0.2 is proximity/mediocre-0p2-v0. An export of other content, such as of another
data.seed, is replaced; the former command brings it back, since the store keeps both datasets.

  datasets=[a,b]                  names in conf/dataset, or all: every file there; the default
  data.seed=0                     of the generation; equal seeds give equal bytes
  data.trajectories=100           of an Industrial Benchmark dataset
  data.steps=1000                 per trajectory; of a robot at most
  data.transitions=1000000        of a robot dataset
{COMMON_HELP}"""


def _export(dataset: OfflineDataset, root: Path) -> str:
    """Export a dataset, one process at a time; what killed ones have left is removed."""
    root.mkdir(parents=True, exist_ok=True)
    with locked(root / ".export.lock"):
        remove_leftovers(root)
        return export_minari(dataset, root)


def _run(settings: Settings) -> int:
    plan = data_plan(settings)
    store = ArtifactStore(settings.store, create=not settings.dry_run)

    def report(outcome: Outcome) -> tuple[list[Path], Metrics]:
        metrics: dict[str, list[tuple[int, float]]] = {}
        root = Path(settings.store) / "minari"
        print(f"{'dataset':<14}{'mean return':>12}{'min':>9}{'max':>9}  folder and Minari id")
        for node in plan:
            if not store.complete(node.key):
                continue
            folder = store.path(node.key) / "dataset"
            dataset = OfflineDataset.open(folder)
            card = dataset.card
            print(
                f"{card.name:<14}{card.first_window_return_mean:>12.1f}"
                f"{card.first_window_return_min:>9.1f}{card.first_window_return_max:>9.1f}"
                f"  {settings.store / folder.relative_to(store.root)}  {_export(dataset, root)}"
            )
            metrics[f"return/{card.name}"] = [(0, card.first_window_return_mean)]
        return [], metrics

    return run_sweep(settings, f"data-{sweep_name(settings, plan)}", plan, report)


if __name__ == "__main__":
    main("generate_data", HELP, _run)
