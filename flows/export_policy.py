"""Take a stored policy away: ``python -m flows.export_policy run=ID to=policy.onnx``."""

import re
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pydantic import Field

from components.data.dataset import OfflineDataset
from components.data.recorded_states import plant_of, recorded_states
from components.policies.export import check_target, export_policy
from components.policies.policy import Policy
from flows.command_line import run_door
from flows.configuration.checking import SettingsError, StoreFolder, StrictModel, build_config
from flows.configuration.words import fields_of_words
from flows.pipeline.remote.bringing import bring
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_experiment import MlflowExperiment
from flows.stored_policy import find_policy

__all__ = ["ExportSettings", "load_export_settings"]

HELP = """\
usage: python -m flows.export_policy run=ID to=TARGET [KEY=VALUE ...]

Write a stored policy into one file that acts without this project, with its scaling, its history
rule and the units of its actions. The file is compared with the policy in 1,000 recorded states
first; one that differs is not kept. docs/export.md says how to run it.

  run=ID             id of the policy's run in MLflow, its key (the folder in mlruns/nodes) or its
                     name, e.g. lion/mediocre-0.2/seed0
  to=policy.onnx     a file for ONNX Runtime; to=policy.pt2 one for PyTorch; to=mlflow a model
                     beside the policy's run, which `mlflow models serve` serves
  snapshot=N         the snapshot after N updates; the last one by default
  overwrite=true     replace a file that is there
  store=mlruns       folder of the runs
"""

_MLFLOW = Path("mlflow")
_EXAMPLES = 2  # histories in the input example of a model


class ExportSettings(StrictModel):
    """Which policy to take where."""

    run: str = Field(min_length=1)
    to: Path
    snapshot: int | None = Field(default=None, ge=1)
    overwrite: bool = False
    store: StoreFolder = Path("mlruns")


def load_export_settings(words: Sequence[str]) -> ExportSettings:
    """Settings from the command line.

    Raises:
        SettingsError: One sentence.
    """
    fields = fields_of_words(words, on_off=["overwrite"])
    for name in ("run", "to"):
        if not fields.get(name):
            raise SettingsError(f"{name}= is missing; write run=ID to=policy.onnx.")
    settings: ExportSettings = build_config(ExportSettings, "", fields)
    if settings.to == _MLFLOW and settings.overwrite:
        raise SettingsError("overwrite=true is for files; MLflow keeps every model, leave it out.")
    try:
        target = Path("policy.onnx") if settings.to == _MLFLOW else settings.to
        check_target(target, overwrite=settings.overwrite or settings.to == _MLFLOW)
    except ValueError as error:
        raise SettingsError(f"to={error}") from error
    return settings


def _snapshot(policy: Policy, settings: ExportSettings) -> Policy:
    """The snapshot that is asked for, as a stack of one."""
    steps = policy.card.steps
    wanted = steps[-1] if settings.snapshot is None else settings.snapshot
    if wanted not in steps:
        known = ", ".join(map(str, steps))
        raise SettingsError(f"snapshot={wanted}: run={settings.run} has none; it has {known}.")
    return policy.lane(steps.index(wanted), replace(policy.card, steps=(wanted,)))


def _run(settings: ExportSettings) -> int:
    bring(settings.store)
    store = ArtifactStore(settings.store, create=False)
    record = find_policy(store, settings.run)
    policy = _snapshot(Policy.load(store.path(record["key"]) / "policy"), settings)
    log = OfflineDataset.open(store.path(record["inputs"]["dataset"]) / "dataset")
    states = recorded_states(log, policy.card.history)
    origin = {"run": record["name"], "key": record["key"]}
    what = f"{record['name']} after {policy.card.steps[0]} updates"

    def write(path: Path) -> None:
        checked = export_policy(
            policy, path, plant_of(log.card), states, origin, overwrite=settings.overwrite
        )
        print(f"{settings.to}: {what}; {checked}.")

    if settings.to != _MLFLOW:
        write(settings.to)
        return 0
    from flows.serving.mlflow_model import log_policy  # imports ONNX, which is optional

    experiment = MlflowExperiment(settings.store, "flows.export_policy")
    with tempfile.TemporaryDirectory(prefix="proximity-bench-") as folder:
        file = Path(folder) / "policy.onnx"
        write(file)
        name = re.sub(r"[^\w-]", "_", record["name"])  # MLflow takes no dots and slashes
        example = states.histories[:: -(-len(states.histories) // _EXAMPLES)]
        model = log_policy(experiment, file, record["key"], name, example)
    address = f"MLFLOW_TRACKING_URI='{experiment.address.tracking}' " * experiment.address.own
    print(
        f"Model: models:/{model}\nServe it, on this computer only, with:\n  {address}mlflow models "
        f"serve --model-uri models:/{model} --env-manager local --host 127.0.0.1 --port 5001"
    )
    return 0


if __name__ == "__main__":
    run_door("export_policy", HELP, load_export_settings, _run)
