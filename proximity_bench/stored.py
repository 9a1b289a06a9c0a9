"""Reads policies from the disk: saved ones, and those of sweeps."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from components.core.integrity import DamagedFileError, load_json
from components.data.card import DatasetCard
from components.policies.policy import Policy as StoredPolicy
from proximity_bench.policies import BEHAVIOUR, FORMAT, ORIGIN, Policy

__all__ = ["load"]


def load(folder: str | Path) -> Policy:
    """Read a policy: what `Policy.save` wrote, or a sweep's `nodes/KEY/policy`.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is damaged, or a file.
    """
    folder = Path(folder).expanduser()
    if folder.is_file():
        raise ValueError(
            f"{folder} is a file: an exported policy runs in onnxruntime or PyTorch "
            "(docs/export.md); here give the folder that `save` or a sweep has written."
        )
    if not folder.exists():
        raise FileNotFoundError(f"There is no folder {folder}; give one that `save` has written.")
    stack = StoredPolicy.load(folder)
    seed, log = _of_sweep(folder) if not (folder / ORIGIN).exists() else _origin(folder / ORIGIN)
    if log is not None and (log.frame_features, log.history) != (
        stack.card.features,
        stack.card.history,
    ):
        said = f"{folder} holds a policy of {stack.card.dataset} and the card of another log"
        raise DamagedFileError(said, folder, "save the policy again")
    behaviour = folder / BEHAVIOUR
    return Policy(stack, seed, log, StoredPolicy.load(behaviour) if behaviour.is_dir() else None)


def _origin(path: Path) -> tuple[int, DatasetCard | None]:
    """Seed and log of a saved policy."""
    origin: Any = load_json(path)
    try:
        if origin["format"] != FORMAT:
            raise ValueError(f"its format is {origin['format']!r}, not {FORMAT!r}")
        return int(origin["seed"]), _card(origin["log"], path)
    except (KeyError, TypeError, ValueError) as error:
        said = f"{path} cannot be used ({str(error).rstrip('.')})"
        raise DamagedFileError(said, path, "save the policy again") from error


def _card(fields: Mapping[str, Any] | None, path: Path) -> DatasetCard | None:
    return None if fields is None else DatasetCard.from_json(json.dumps(fields), path)


def _of_sweep(folder: Path) -> tuple[int, DatasetCard | None]:
    """Seed and log of a policy in a store, as far as they are to be found."""
    record = folder.parent / "node.json"
    if not record.is_file():
        return 0, None
    node: Any = load_json(record)
    card = folder.parents[1] / str(node["inputs"].get("dataset")) / "dataset" / "card.json"
    return int(node["config"]["seed"]), DatasetCard.load(card) if card.is_file() else None
