"""The state of learners as flat mappings of tensors, which checkpoints store and restore."""

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

__all__ = [
    "load_optimizer_state",
    "module_state",
    "optimizer_state",
    "prefixed",
    "with_prefix",
]


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
    """Restore what :func:`optimizer_state` returned."""
    for number, parameter in enumerate(_parameters(optimizer)):
        entries = with_prefix(str(number), flat)
        if not entries:
            continue
        state = optimizer.state[parameter]
        for name, tensor in entries.items():
            value = tensor[0] if name == "step" else tensor
            # A fused optimiser needs its step counter on the parameter's device.
            state[name] = value.clone().to(parameter.device)
