"""The speed benchmarks run and print their tables; no speed is asserted."""

import sys

import pytest

from benchmarks import environment


def test_environment_benchmark_prints_a_table(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["environment", "--copies", "20", "--seconds", "0.01"])
    environment.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("| environment | copies | steps per second |")
    copies = [line.split("|")[2].strip() for line in lines[2:9]]
    assert copies == ["1", "1", "1", "10", "20", "100", "200"]
    assert "NumPy" in lines[-1]
