"""Formats of files that hold a deployed policy: how each is written, read back and run.

- ``.onnx`` is run by ONNX Runtime and many others, without Python too;
- ``.pt2`` is PyTorch's own, loaded by ``torch.export.load`` with PyTorch alone.

Either is one file with a card in it, JSON under the name `CARD`, that says what the file is.
"""

import importlib.util
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch

from components.policies.policy import Policy
from components.policies.portable import Plant, traced

__all__ = ["CARD", "FORMATS", "Format", "format_of"]

CARD: Final = "card.json"
Floats = npt.NDArray[np.float32]
Run = Callable[[Mapping[str, Floats]], Floats]
"""From inputs by name to actions ``[B, A]``."""


@dataclass(frozen=True)
class Format:
    """A format of files.

    Attributes:
        write: Writes a stack of one for a plant, with the text of a card.
        read: Opens what was written, as a function.
        packages: Optional packages of this project that it takes.
    """

    write: Callable[[Policy, Plant, str, Path], None]
    read: Callable[[Path], Run]
    packages: tuple[str, ...] = ()


def format_of(path: Path) -> Format:
    """The format that a file's name ends with, with all that it takes.

    Raises:
        ValueError: There is none of this ending, or a package is not installed.
    """
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path} must end in {' or '.join(FORMATS)}.")
    found = FORMATS[path.suffix.lower()]
    lacking = [name for name in found.packages if importlib.util.find_spec(name) is None]
    if lacking:
        raise ValueError(
            f"{path} cannot be written without {' and '.join(lacking)}; install what exports take "
            "with: pip install 'proximity-bench[export]'"
        )
    return found


def _write_onnx(policy: Policy, plant: Plant, card: str, path: Path) -> None:
    program, dynamic = traced(policy, plant)
    with _quiet():
        made = torch.onnx.export(
            program,
            dynamo=True,
            verbose=False,
            output_names=["action"],
            dynamic_shapes=dynamic,
        )
        if made is None:
            raise RuntimeError("PyTorch made no ONNX program.")
        for node in made.model.graph:
            node.metadata_props.clear()  # names files of this computer
        made.model.metadata_props.clear()
        made.model.metadata_props[CARD] = card
        made.model.producer_name = "proximity-bench"
        made.save(path, external_data=False)


def _read_onnx(path: Path) -> Run:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # threads of a policy of this size only wait for one another
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def run(inputs: Mapping[str, Floats]) -> Floats:
        [action] = session.run(None, dict(inputs))
        return np.asarray(action)

    return run


def _write_pt2(policy: Policy, plant: Plant, card: str, path: Path) -> None:
    program, _ = traced(policy, plant)
    content = BytesIO()  # PyTorch would hide why a file cannot be written
    with _quiet():
        torch.export.save(program, content, extra_files={CARD: card})
    path.write_bytes(content.getvalue())


def _read_pt2(path: Path) -> Run:
    with _quiet():
        module: Any = torch.export.load(path).module()

    def run(inputs: Mapping[str, Floats]) -> Floats:
        with torch.no_grad():
            action = module(**{name: torch.from_numpy(value) for name, value in inputs.items()})
        return np.asarray(action)

    return run


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what PyTorch's exporters say of other packages and of their own code."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)


FORMATS: Final[Mapping[str, Format]] = MappingProxyType(
    {
        ".onnx": Format(_write_onnx, _read_onnx, ("onnx", "onnxscript", "onnxruntime")),
        ".pt2": Format(_write_pt2, _read_pt2),
    }
)
"""By the ending of the file's name."""
