"""The software and the device that computed a node.

They are no part of keys, since results of different ones are meant to agree. They do to rounding
only, which a long training may turn into other policies: who compares numbers wants to know.
"""

import platform
import sys
from functools import cache
from pathlib import Path

__all__ = ["processor", "software"]

_PACKAGES = ("mujoco", "numpy", "torch")


def software(device: str) -> dict[str, str]:
    """What this process computes with.

    Args:
        device: "cpu" or "cuda".

    Returns:
        The versions of the packages that it has loaded, the name of the device and, with PyTorch,
        the precision of products in float32 ("highest" unless TF32 or less is allowed).
    """
    loaded = {name: sys.modules[name] for name in _PACKAGES if name in sys.modules}
    found = {
        name: str(getattr(module, "__version__", "unknown")) for name, module in loaded.items()
    }
    found["device"] = processor()
    if "torch" in loaded:
        found["float32"] = loaded["torch"].get_float32_matmul_precision()
        if device == "cuda":
            found["device"] = loaded["torch"].cuda.get_device_name()
    return found


@cache
def processor() -> str:
    """The model of this computer's processors."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, "") or platform.processor() or platform.machine()
