"""Reading the inputs of a job and writing its artifact, in the forms that all components share.

Hyperparameter search imports this module: it must reach no environment and no algorithm.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from components.core.integrity import DamagedFileError
from components.data.dataset import OfflineDataset
from components.training.cuda_graphs import lost_graphs
from flows.pipeline.task import Job

__all__ = [
    "config_object",
    "inherit_datasets",
    "note_dataset",
    "noting_lost_graphs",
    "open_dataset",
    "percent",
    "read_input",
    "write_curves",
    "write_numbers",
]

T = TypeVar("T")


def write_numbers(path: Path, value: Any) -> None:
    """Write a JSON file of an artifact that is still being made.

    Raises:
        ValueError: It holds numbers that are not finite.
    """
    path.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def write_curves(path: Path, curves: Mapping[str, tuple[Sequence[int], Sequence[float]]]) -> None:
    """Write learning curves as the pipeline reads them: two arrays per name."""
    arrays = {}
    for name, (steps, values) in curves.items():
        arrays[f"{name}/step"] = np.asarray(steps, dtype=np.int64)
        arrays[f"{name}/value"] = np.asarray(values, dtype=np.float64)
    with path.open("wb") as file:
        np.savez(file, **arrays)


def read_input(job: Job, role: str, reader: Callable[[Path], T], name: str) -> T:
    """Read an input; whatever is wrong with it says where it lies.

    Raises:
        DamagedFileError: The input is damaged, or holds something else.
    """
    path = job.inputs[role] / name
    try:
        return reader(path)
    except DamagedFileError:
        raise
    except ValueError as error:
        raise DamagedFileError(str(error), path) from error


def open_dataset(job: Job) -> OfflineDataset:
    """The dataset a job reads."""
    return read_input(job, "dataset", OfflineDataset.open, "dataset")


def note_dataset(job: Job, dataset: OfflineDataset) -> None:
    """Record which dataset an artifact is about."""
    card = dataset.card
    entry = {"name": card.name, "digest": card.digest[:32], "source": card.environment}
    write_numbers(job.out / "datasets.json", [entry])


@contextmanager
def noting_lost_graphs(jobs: Sequence[Job]) -> Iterator[None]:
    """Tag what the block makes of jobs, if it trains without a CUDA graph that it should have."""
    with lost_graphs() as lost:
        yield
    for job in jobs if lost else ():
        reasons = "; ".join(dict.fromkeys(lost))
        write_numbers(job.out / "tags.json", {"graphs": f"lost: {reasons}"})


def config_object(kind: type, fields: Mapping[str, Any]) -> Any:
    """A configuration object from JSON, where tuples have become lists."""
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()})


def inherit_datasets(job: Job, role: str) -> None:
    """Name the dataset that the evaluated policies were trained on."""
    listed = job.inputs[role] / "datasets.json"
    (job.out / "datasets.json").write_text(listed.read_text(encoding="utf-8"), encoding="utf-8")


def percent(proximities: np.ndarray) -> list[int]:
    """Proximities as the whole-numbered steps of a curve."""
    return [round(100 * float(value)) for value in proximities]
