"""What a computer is, what it computes with and what it has spent, for the records of artifacts.

Software and device are no part of keys, since results of different ones are meant to agree. They do
to rounding only, which a long training may turn into other policies: who compares numbers wants to
know.
"""

import gc
import os
import platform
import resource
import sys
from functools import cache
from pathlib import Path

__all__ = [
    "cpu_seconds",
    "device_model",
    "hardware",
    "processor",
    "release_memory",
    "set_precision",
    "software",
]

_PACKAGES = ("mujoco", "numpy", "torch")


def cpu_seconds() -> float:
    """Processor time of this process and of its ended children."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def release_memory() -> None:
    """Gives back what nobody holds any more, a GPU's memory too: others may be short of it."""
    gc.collect()
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available():
        torch.cuda.empty_cache()


def hardware(device: str) -> str:
    """The computer's processors, memory and software in one line, without its name.

    Of a GPU also the precision of its products of float32.
    """
    line = _processors()
    if device == "cuda" and "torch" in sys.modules:
        torch = sys.modules["torch"]
        precision = torch.get_float32_matmul_precision()
        line += f", {torch.cuda.get_device_name()} in {precision} float32 precision"
    return line


@cache
def _processors() -> str:
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
        size = f", {memory:.0f} GiB"
    except (OSError, ValueError):
        size = ""
    return f"{os.cpu_count()} x {processor()}{size}, Python {platform.python_version()}"


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
    found["device"] = device_model(device)
    if "torch" in loaded:
        found["float32"] = loaded["torch"].get_float32_matmul_precision()
    return found


def device_model(device: str) -> str:
    """The model of the GPU, or of the processors.

    Args:
        device: "cpu" or "cuda"; of the latter, PyTorch must be loaded.
    """
    if device == "cuda" and "torch" in sys.modules:
        return str(sys.modules["torch"].cuda.get_device_name())
    return processor()


def set_precision(device: str, precision: str) -> None:
    """Set how a GPU multiplies matrices of float32 in this process, if it has loaded PyTorch.

    PyTorch's own setting of that name would also change the products of a CPU, to bfloat16 with
    "medium".

    Args:
        device: "cpu", which keeps full precision, or "cuda".
        precision: "highest"; "high" and "medium" allow TF32, to which medium adds nothing on
            today's GPUs.
    """
    if device == "cuda" and "torch" in sys.modules:
        sys.modules["torch"].backends.cuda.matmul.allow_tf32 = precision != "highest"


@cache
def processor() -> str:
    """The model of this computer's processors."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, "") or platform.processor() or platform.machine()
