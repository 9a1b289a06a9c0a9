"""What the benchmarks share: timing side by side, Markdown tables, a line about the computer.

PyTorch is imported where it is needed: a benchmark of the driver measures a process without it.
"""

import datetime
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

__all__ = ["computer", "markdown", "median_seconds", "processor"]


def median_seconds(
    runs: Mapping[str, Callable[[], object]], repetitions: int = 3
) -> dict[str, float]:
    """Median seconds of each run, after one warm-up.

    The runs take turns, so that other work on the computer slows all of them down alike and their
    ratios stay meaningful. Work queued on a GPU is waited for.

    Args:
        runs: Name -> what to time.
        repetitions: How often each is timed.

    Raises:
        ValueError: Less than one repetition.
    """
    if repetitions < 1:
        raise ValueError(f"repetitions is {repetitions}; give at least 1.")
    for run in runs.values():
        run()
    _settle()
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repetitions):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            _settle()
            seconds[name].append(time.perf_counter() - begin)
    return {name: statistics.median(values) for name, values in seconds.items()}


def _settle() -> None:
    import torch

    if torch.cuda.is_available():
        torch.cuda.synchronize()


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> str:
    """A Markdown table.

    Args:
        columns: Headings.
        rows: Cells.
        texts: How many columns at the left are text; the others are aligned to the right.
    """
    rule = ["---"] * texts + ["---:"] * (len(columns) - texts)
    lines = ["| " + " | ".join(cells) + " |" for cells in (columns, *rows)]
    return "\n".join([lines[0], "|" + "|".join(rule) + "|", *lines[1:]])


def processor() -> str:
    """The processor's name."""
    path = Path("/proc/cpuinfo")
    if path.is_file():
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def computer(device: str = "cpu") -> str:
    """One line: processor, cores, threads, versions, date; the GPU if one was used."""
    import torch

    used = f", {torch.cuda.get_device_name(device)}" if device.startswith("cuda") else ""
    today = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
    return (
        f"{processor()}{used}; {os.cpu_count()} cores, {torch.get_num_threads()} PyTorch "
        f"thread(s); Python {platform.python_version()}, PyTorch {torch.__version__}; {today}"
    )
