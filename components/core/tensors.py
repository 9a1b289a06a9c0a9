"""Tensors on disk: safetensors files that appear whole or not at all and are never unpickled."""

import errno
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

__all__ = [
    "load_optimizer_state",
    "load_tensors",
    "module_state",
    "optimizer_state",
    "prefixed",
    "save_tensors",
    "with_prefix",
]


def save_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Write tensors and a JSON header to ``path`` by way of a temporary name beside it.

    Raises:
        OSError: If the disk is full or the folder cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        save_file(contiguous, temporary, metadata={"header": json.dumps(header)})
        os.replace(temporary, path)
    except SafetensorError as error:
        full = f"os error {errno.ENOSPC}" in str(error)
        raise OSError(errno.ENOSPC if full else errno.EIO, str(error), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what :func:`save_tensors` wrote.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is no safetensors file or lacks its header.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist.")
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {})["header"])
            return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118
    except (SafetensorError, KeyError, json.JSONDecodeError) as error:
        raise ValueError(
            f"{path} is damaged or was not written by this project ({error})."
        ) from error


def prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Put ``prefix`` and a dot before every name."""
    return {f"{prefix}.{name}": tensor for name, tensor in tensors.items()}


def with_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The entries whose names start with ``prefix`` and a dot, without it."""
    start = f"{prefix}."
    return {k.removeprefix(start): v for k, v in tensors.items() if k.startswith(start)}


def module_state(modules: Mapping[str, nn.Module]) -> dict[str, Tensor]:
    """Parameters of several named modules in one flat mapping."""
    return {
        f"{prefix}.{name}": tensor
        for prefix, module in modules.items()
        for name, tensor in module.state_dict().items()
    }


def _parameters(optimizer: torch.optim.Optimizer) -> Iterable[Tensor]:
    return (p for group in optimizer.param_groups for p in group["params"])


def optimizer_state(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Moments and step counts, every tensor with the parameter's lane axis first."""
    flat = {}
    for number, parameter in enumerate(_parameters(optimizer)):
        for name, value in optimizer.state.get(parameter, {}).items():
            tensor = torch.as_tensor(value)
            lanes = parameter.shape[0]
            flat[f"{number}.{name}"] = tensor.expand(lanes).clone() if tensor.ndim == 0 else tensor
    return flat


def load_optimizer_state(optimizer: torch.optim.Optimizer, flat: Mapping[str, Tensor]) -> None:
    """Put back what :func:`optimizer_state` returned."""
    for number, parameter in enumerate(_parameters(optimizer)):
        entries = with_prefix(str(number), flat)
        if not entries:
            continue
        state = optimizer.state[parameter]
        for name, tensor in entries.items():
            value = tensor[0] if name == "step" else tensor
            # A fused optimiser wants its step counter where the parameter lives.
            state[name] = value.clone().to(parameter.device)
