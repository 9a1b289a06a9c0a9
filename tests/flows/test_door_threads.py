"""What all doors say before anything starts."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from flows import full_benchmark, generate_data, train_experts, tune_models
from flows.command_line import main
from flows.pipeline.executors import processors, ray


@pytest.fixture
def said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Gives a door words on a computer of two processors; its exit code and what it says."""
    for module in (processors, ray, sys.modules["flows.command_line"]):
        monkeypatch.setattr(module, "available_cpus", lambda: 2)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)

    def give(door: object, *words: str) -> tuple[int, str]:
        name = door.__name__.rpartition(".")[2]  # type: ignore[attr-defined]
        monkeypatch.setattr(
            sys, "argv", [name, "profile=smoke", f"store={tmp_path / 'mlruns'}", *words]
        )
        with pytest.raises(SystemExit) as ended:
            main(name, door.HELP, door._run, getattr(door, "ALIASES", {}))  # type: ignore[attr-defined]
        assert not (tmp_path / "mlruns" / "nodes").exists() or "dry_run=true" not in words
        return int(str(ended.value)), capsys.readouterr().err

    return give


@pytest.mark.parametrize("door", [full_benchmark, generate_data, train_experts, tune_models])
@pytest.mark.parametrize("dry", ["dry_run=true", "dry_run=false"])
def test_threads_without_processors_are_refused_at_once(
    door: object, dry: str, said: Callable[..., tuple[int, str]]
) -> None:
    code, text = said(door, dry, "runner.threads=3")
    assert code == 1
    assert text.endswith(
        ": runner.threads=3, but a task can have no more than 2 of the processors: "
        "give runner.threads=2 or less.\n"
    )
    assert len(text.splitlines()) == 1


@pytest.mark.parametrize("executor", ["ray", "serial"])
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("runner.threads=3",), "no more than 2 of"),
        (("runner.threads=2", "runner.cpus=1"), "no more than 1 of"),
        (("runner.threads=2",), ""),
    ],
)
def test_threads_are_compared_with_what_a_task_can_have(
    executor: str,
    words: tuple[str, ...],
    sentence: str,
    said: Callable[..., tuple[int, str]],
) -> None:
    code, text = said(full_benchmark, "dry_run=true", f"runner.executor={executor}", *words)
    assert (code, sentence in text) == (int(bool(sentence)), True)
