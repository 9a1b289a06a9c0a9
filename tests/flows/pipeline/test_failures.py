"""What is said of a failed task: the error, and where in this project's code it was raised."""

from pathlib import Path

import pytest
import torch

from components.algorithms.parts.learner import needed
from components.core.integrity import DamagedFileError
from flows.pipeline.failures import failure_line, failure_reason


def reason_of(error: BaseException) -> str:
    return failure_reason(error, Path("mlruns"))


def test_an_error_names_the_line_of_our_code_that_raised_it() -> None:
    with pytest.raises(ValueError, match="need noise") as raised:
        needed(None, "noise")
    line = needed.__code__.co_firstlineno
    said = failure_line(reason_of(raised.value))
    assert said.startswith("ValueError: These policies need noise. (components/algorithms/parts/")
    assert line < int(said.split("line ")[1].split(",")[0]) < line + 12
    assert said.endswith(", in needed)")


def test_an_error_of_a_library_names_our_line_that_called_it() -> None:
    from components.networks import lanewise_mean

    with pytest.raises(IndexError) as raised:
        lanewise_mean(torch.tensor(1.0))
    assert failure_line(reason_of(raised.value)).endswith(", in lanewise_mean)")


def test_sentences_stay_as_they_are() -> None:
    assert failure_line("The worker died.\n") == "The worker died."
    assert failure_line("") == "no reason given"
    with pytest.raises(ValueError, match="need noise") as raised:
        needed(None, "noise")
    memory = MemoryError()
    memory.__cause__ = raised.value
    assert failure_line(reason_of(memory)).startswith("Memory ran out: lower")
    damaged = DamagedFileError("a.npz is damaged", None)
    damaged.__cause__ = raised.value
    assert failure_line(reason_of(damaged)).endswith("has it made again.")
