"""What a node's record says about the software that computed it."""

import sys

import pytest
import torch

from flows.pipeline.computer import hardware, processor, set_precision, software


def test_a_task_on_the_processor() -> None:
    found = software("cpu")
    assert found["torch"] == torch.__version__
    assert found["float32"] == "highest"
    assert found["device"] == processor() != ""


def test_a_task_on_a_gpu_that_may_use_less_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA H200")
    monkeypatch.setattr(torch, "get_float32_matmul_precision", lambda: "high")
    found = software("cuda")
    assert (found["device"], found["float32"]) == ("NVIDIA H200", "high")
    assert hardware("cuda") == f"{hardware('cpu')}, NVIDIA H200 in high float32 precision"


def test_what_a_task_has_not_used_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setitem(sys.modules, "mujoco", torch)
    found = software("cpu")
    assert found.keys() >= {"mujoco", "device"}
    assert found.keys().isdisjoint({"torch", "float32"})


@pytest.mark.parametrize(
    ("device", "precision", "found"),
    [
        ("cuda", "highest", "highest"),
        ("cuda", "high", "high"),
        ("cuda", "medium", "high"),  # which is all that GPUs have
        ("cpu", "medium", "highest"),
    ],
)
def test_precision_is_that_of_a_gpu_alone(device: str, precision: str, found: str) -> None:
    on_the_processor = torch.backends.mkldnn.matmul.fp32_precision
    try:
        set_precision(device, precision)
        assert torch.get_float32_matmul_precision() == found
        assert torch.backends.mkldnn.matmul.fp32_precision == on_the_processor
    finally:
        set_precision("cuda", "highest")


def test_without_pytorch_there_is_no_precision_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "torch")
    set_precision("cuda", "high")
