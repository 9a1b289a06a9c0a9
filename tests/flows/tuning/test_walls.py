"""A search reaches no real system: it loads no environment and steps none."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from components.environments.industrial import benchmark as industrial_benchmark
from flows.configuration.settings import load_settings
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.tracker import NullTracker
from flows.planning.benchmark import data_plan
from flows.planning.studies import study_specifications
from flows.tuning.journal import open_journal
from flows.tuning.search import search
from flows.tuning.study import Study
from flows.tuning.trials import NullTrials

FORBIDDEN = (
    "components.environments", "components.evaluation", "components.algorithms",
    "gymnasium", "mujoco",
)  # fmt: skip


@pytest.mark.slow(2)
def test_search_code_loads_no_environment_evaluation_or_algorithm() -> None:
    script = (
        "import pkgutil, sys, importlib, flows.tasks.model_fitting, flows.tuning\n"
        "for module in pkgutil.iter_modules(flows.tuning.__path__, 'flows.tuning.'):\n"
        "    importlib.import_module(module.name)\n"
        "print('flows.tuning.search' in sys.modules, 'components.models' in sys.modules)\n"
        f"print([m for m in sys.modules if m.startswith({FORBIDDEN!r})])"
    )
    command = [sys.executable, "-c", script]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[3],
        env=os.environ,
    )  # fmt: skip
    assert done.stdout.splitlines() == ["True True", "[]"]


@pytest.mark.slow(2)
def test_no_environment_is_stepped_during_a_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = load_settings(
        [
            "profile=smoke", "data.trajectories=4", "data.steps=90", f"store={tmp_path}",
            "tuning.models=[behaviour_policy,recurrent_ensemble]",
        ]
    )  # fmt: skip
    store = ArtifactStore(tmp_path)

    def generate() -> int:
        return run_plan(
            data_plan(settings), store, NullTracker(), Display(), executor=SerialExecutor()
        ).exit_code

    stepped = []

    def refuse(*args: object, **kwargs: object) -> None:
        stepped.append(args)
        raise AssertionError("a real system was touched")

    kinds = [
        kind
        for module in list(sys.modules.values())
        if getattr(module, "__name__", "").startswith("components.environments")
        for kind in vars(module).values()
        if isinstance(kind, type) and (hasattr(kind, "step") or hasattr(kind, "reset"))
    ]
    assert industrial_benchmark.IndustrialBenchmark in kinds

    with monkeypatch.context() as patched:
        for kind in kinds:
            for name in {"step", "reset"} & set(vars(kind)):
                patched.setattr(kind, name, refuse)
        # The trap works: data generation falls into it.
        assert generate() == 1
        assert stepped
    assert generate() == 0

    stepped.clear()
    for kind in kinds:
        for name in {"step", "reset"} & set(vars(kind)):
            monkeypatch.setattr(kind, name, refuse)
    journal = open_journal(tmp_path / "journal.log")
    studies = [Study(specification, journal) for specification in study_specifications(settings)]
    outcome = search(studies, 2, store, NullTrials(), SerialExecutor(), lambda text: None)
    assert outcome.exit_code == 0
    assert [study.ended for study in studies] == [2, 2]
    assert stepped == []
