"""Exports a deployed policy into one file that acts without this project, and checks the file.

The file holds everything: networks, scaling, the units of the actions, and a card that says what
goes in and what comes out. It appears under its name after it has been compared with the original
(:mod:`components.policies.portable_check`), or not at all.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from components.core.files import replacing
from components.core.version import code_version
from components.policies.policy import Policy
from components.policies.portable import BATCH, Plant, input_shapes
from components.policies.portable_check import (
    PROXIMITIES,
    ROUNDINGS,
    TOLERANCE,
    Checked,
    States,
    compare,
)
from components.policies.portable_files import format_of

__all__ = ["check_target", "export_policy", "portable_card"]

_FORMAT: Final = "proximity-bench policy/1"
_MEANINGS: Final = {
    "history": "raw frames in the units of the log, the newest first; before the start of an "
    "episode its first frame repeats",
    "proximity": "0: act as it was always done, to 1: as the model thinks is best",
    "noise": "standard normal numbers, drawn anew at every step; each row makes a candidate, of "
    "which the critic's favourite is the action",
}


def check_target(path: Path, *, overwrite: bool = False) -> None:
    """Refuse a file that could not be written, before anything is computed.

    Raises:
        ValueError: Its name has another ending, packages are missing, there is a file already, or
            its folder cannot be written.
    """
    format_of(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder; name a file.")
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists; name another file, or overwrite it with overwrite=true.")
    nearest = next(place for place in path.absolute().parents if place.exists())
    if not nearest.is_dir():
        raise ValueError(f"{path}: {nearest} is a file; name a file in a folder.")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ValueError(f"{path}: {nearest} may not be written; name a file elsewhere.")


def export_policy(
    policy: Policy,
    path: Path,
    plant: Plant,
    states: States,
    origin: Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
) -> Checked:
    """Write a file that acts as a policy, check it, and give it its name.

    Args:
        policy: A stack of one.
        path: The file, ``.onnx`` or ``.pt2``. Its folder is made.
        plant: Whose units the actions get.
        states: In which the file is compared with the policy.
        origin: What else its card is to say, such as a name of the policy.
        overwrite: Whether it may replace another file.

    Raises:
        ValueError: The name has another ending, a package is missing, there is a file of this name,
            or the file does not act as the policy; nothing is left behind.
    """
    check_target(path, overwrite=overwrite)
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = format_of(path)
    card = json.dumps(portable_card(policy, plant, states, origin or {}), indent=1, allow_nan=False)
    with replacing(path) as temporary:
        kind.write(policy, plant, card, temporary)
        try:
            checked = compare(policy, plant, kind.read(temporary), states)
        except ValueError as error:
            raise ValueError(f"{path} is not written: it {error}.") from error
    return checked


def portable_card(
    policy: Policy, plant: Plant, states: States, origin: Mapping[str, Any]
) -> dict[str, Any]:
    """What a file says of itself: what goes in, what comes out, where it comes from."""
    card = policy.card
    inputs = {
        name: {"shape": [BATCH, *shape], "dtype": "float32", "meaning": _MEANINGS[name]}
        for name, shape in input_shapes(card).items()
    }
    inputs["history"]["features"] = list(card.features)
    moments = zip(policy.frames.mean[0].tolist(), policy.frames.scale[0].tolist(), strict=True)
    inputs["history"]["usual"] = [{"mean": m, "deviation": s} for m, s in moments]
    if "proximity" in inputs:
        inputs["proximity"]["range"] = [0.0, 1.0]
    check: dict[str, Any] = {
        "states": len(states.histories),
        "source": states.source,
        "tolerance": TOLERANCE,
        "of": f"half an action's range, or {ROUNDINGS:g} times the policy's own rounding errors",
    }
    if card.takes_proximity:
        check["proximities"] = list(PROXIMITIES)
    return {
        "format": _FORMAT,
        "algorithm": card.algorithm,
        "dataset": card.dataset,
        **origin,
        "updates": card.steps[0],
        "inputs": inputs,
        "output": {
            "name": "action",
            "shape": [BATCH, card.actions],
            "dtype": "float32",
            "actions": list(plant.actions),
            "bounds": plant.limits.tolist(),
            "units": "of the plant" if plant.bounds else "scaled to [-1, 1]",
        },
        "sampling": plant.sampling or None,  # seconds, or in the unit of the log's own time
        "check": check,
        "log_digest": plant.log_digest or None,
        "weights_digest": _digest(policy),
        "versions": {
            "proximity-bench": code_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
    }


def _digest(policy: Policy) -> str:
    """sha256 over the names and bytes of everything that the policy computes with."""
    digest = hashlib.sha256()
    for name, tensor in policy.tensors().items():
        digest.update(f"{name} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()
