"""Old keys of settings and their names of today."""

from collections.abc import Mapping

from omegaconf import DictConfig

__all__ = ["RENAMED", "rename_old_keys"]

RENAMED: Mapping[tuple[str, str], str] = {
    ("evaluation", "lambda_step"): "proximity_step",
    ("runner", "stack"): "pack",
}
"""Old keys, each with its group, and their names of today."""


def rename_old_keys(layer: DictConfig) -> DictConfig:
    """Give old keys of a file or a command line their names of today; changes the layer."""
    for (group, old), new in RENAMED.items():
        fields = layer.get(group)
        if isinstance(fields, DictConfig) and old in fields:
            fields[new] = fields.pop(old)
    return layer
