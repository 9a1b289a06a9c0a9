"""What is held out reaches no fit: neither its transitions nor the scaling of what models read."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from components.core.random_streams import lane_key
from components.core.tensors import load_tensors
from components.models import MODELS
from tests.components.synthetic import CPU, make_log

ONE_STAGE: dict[str, dict[str, Any]] = {
    "behaviour_policy": {"epochs": 1},
    "gaussian_behaviour": {"epochs": 1},
    "recurrent_ensemble": {"updates": 3, "validate_every": 3, "warm_up": 4, "horizon": 6},
    "deterministic_ensemble": {"epochs": 1, "target": "value"},
    "gaussian_ensemble": {"epochs": 1, "target": "value"},
    "residual_ensemble": {"epochs": 1},
    "action_vae": {"epochs": 1, "hidden": (8,)},
}
"""Settings with a single validation: held-out losses have nothing to choose from."""


@pytest.mark.parametrize("name", sorted(MODELS))
def test_no_model_reads_what_is_held_out(name: str, tmp_path: Path) -> None:
    kind = MODELS[name]
    config = kind.config(**ONE_STAGE[name])
    log = make_log(episodes=5, steps=40)
    frames, actions = log.frames.copy(), log.actions.copy()
    frames[4 * 41 :] += 7.0  # the last of five trajectories is held out
    actions[4 * 40 :] *= -1.0
    other = replace(log, frames=frames, actions=actions)
    stored = []
    for part, given in (("as it was", log), ("changed", other)):
        fit = kind.fit(given, config, lane_key(name), CPU)
        (tmp_path / part).mkdir()
        fit.model.save(tmp_path / part)
        files = sorted((tmp_path / part).glob("*.safetensors"))
        stored.append(({f.name: load_tensors(f)[0] for f in files}, fit.validation_loss))
    (ours, loss), (theirs, other_loss) = stored
    assert ours.keys() == theirs.keys() != set()
    for file, tensors in ours.items():
        for part, tensor in tensors.items():
            assert torch.equal(tensor, theirs[file][part]), f"{part} of {file}"
    assert np.isfinite(loss)
    assert loss != other_loss
