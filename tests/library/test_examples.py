"""The ten lines of the README run as they stand there, with small budgets."""

import re
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest

import proximity_bench as pb
from tests.conftest import ROOT
from tests.flows.furnace import as_csv, furnace, write_schema

SMALL: dict[str, Any] = {"updates": 3, "hidden": [8], "trajectories": 6, "horizon": 5}
MODELS = {
    "behaviour_policy": {"hidden": [8], "epochs": 1},
    "recurrent_ensemble": {"members": 2, "hidden": 4, "updates": 4, "batch": 8},
}


def example() -> str:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    [code] = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    return str(code)


def test_ten_lines_are_no_more() -> None:
    assert len(example().strip().splitlines()) <= 10


@pytest.mark.slow(2)
def test_the_ten_lines_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train, asked = pb.train, {}

    def small(log: Any, algorithm: str, **options: Any) -> Any:
        asked.update(options)
        return partial(train, models=MODELS, progress=False, **SMALL)(log, algorithm)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pb, "train", small)
    Path("furnace.csv").write_text(as_csv(furnace(rows=100)), encoding="utf-8")
    write_schema(tmp_path)
    names: dict[str, Any] = {}
    exec(example(), names)
    assert asked == {"updates": 200, "models": {"recurrent_ensemble": {"updates": 300}}}
    gas, air = names["action"]
    assert 0 <= gas <= 100
    assert 0 <= air <= 50
    scaled = names["policy"].act(names["rows"].tail(10), proximity=0.3, scaled=True)
    np.testing.assert_allclose([gas, air], (scaled + 1) / 2 * [100, 50])


def test_an_imported_logs_policy_acts_in_an_environment_of_gymnasiums() -> None:
    """The page's loop, in Pendulum, whose torque its log has in its own units."""
    page = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
    [code] = re.findall(r"```python\n(def mean_return.*?)\n\n\nmean_return\(", page, re.DOTALL)
    names: dict[str, Any] = {"np": np}
    exec(code, names)
    pendulum = gymnasium.make("Pendulum-v1")
    rows = []
    for episode in range(2):
        pendulum.action_space.seed(episode)
        frame, _ = pendulum.reset(seed=episode)
        for _ in range(30):
            action = pendulum.action_space.sample()
            after, reward, *_ = pendulum.step(action)
            rows.append([*frame, *action, reward, episode])
            frame = after
    table = pd.DataFrame(rows, columns=["x", "y", "speed", "torque", "reward", "run"])
    schema = {
        "features": ["x", "y", "speed"],
        "actions": {"torque": [-2, 2]},
        "reward": "reward",
        "outcome_row": "same",
        "episode": "run",
        "history": 3,
        "discount": 0.97,
    }
    log = pb.dataset(table, schema=schema, name="pendulum")
    policy = pb.train(log, "bc", updates=3, hidden=[8], progress=False)
    found = names["mean_return"](policy, pendulum, episodes=2)
    assert -200 * 17 < found < 0  # of 200 steps, each at least -16.3
