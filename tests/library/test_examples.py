"""The ten lines of the README run as they stand there, with small budgets."""

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
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
