"""The speed benchmarks run, compare like with like and print their tables; no speed is asserted."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks import __main__ as all_benchmarks
from benchmarks import environment, lanes, measure, pipeline, recurrent
from components.data.catalogue import DATASETS, generate
from components.models.recurrent_ensemble import RecurrentEnsembleConfig

TINY = RecurrentEnsembleConfig(members=2, hidden=5, warm_up=4, horizon=6, batch=7)
SETTINGS = {
    "td3_bc": {"hidden": (8,), "batch": 16},
    "lion": {"hidden": (8,), "trajectories": 6, "horizon": 5},
}


def cells(table: str) -> list[list[str]]:
    """A Markdown table without its rule."""
    lines = [line for line in table.splitlines() if line.startswith("|")]
    return [[c.strip() for c in line.strip("|").split("|")] for line in lines if "---" not in line]


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


def test_the_runs_of_a_comparison_take_turns() -> None:
    order: list[str] = []
    runs = {"a": lambda: order.append("a"), "b": lambda: order.append("b")}
    seconds = measure.median_seconds(runs, repetitions=3)
    assert order == ["a", "b"] * 4  # the first round warms up
    assert set(seconds) == {"a", "b"}
    with pytest.raises(ValueError, match="repetitions is 0; give at least 1"):
        measure.median_seconds(runs, repetitions=0)


def test_lanes_table_relates_the_stack_to_the_programs_of_one_lane() -> None:
    updates = {"td3_bc": 1, "lion": 1}
    header, *rows = cells(lanes.report("cpu", 1, updates, trajectories=2, settings=SETTINGS))
    assert header[:2] == ["learner", "program"]
    programs = ["5 programs of 1 lane, in turn", "1 program of 5 lanes"]
    assert [row[:2] for row in rows] == [[name, p] for name in updates for p in programs]
    assert [row[4] for row in rows[::2]] == ["1.00", "1.00"]


@pytest.mark.parametrize("algorithm", ["td3_bc", "lion"])
def test_both_sides_of_the_lanes_benchmark_do_the_same_work(algorithm: str) -> None:
    dataset = generate(replace(DATASETS["mediocre-0.2"], trajectories=2), seed=0)
    device = torch.device("cpu")
    stack = lanes.program(algorithm, dataset, range(5), device, **SETTINGS[algorithm])
    alone = lanes.program(algorithm, dataset, [3], device, **SETTINGS[algorithm])
    for step in range(2):
        stacked, single = stack.update(step), alone.update(step)
    assert single.keys() == stacked.keys()
    for name, value in single.items():
        # The same float32 sums in another order, after two updates.
        torch.testing.assert_close(stacked[name][3:4], value, rtol=1e-4, atol=1e-5)


def test_the_plain_recurrent_loop_computes_what_the_stacked_scan_does() -> None:
    weight, readout, windows, targets = recurrent.random_problem(TINY, torch.device("cpu"))
    networks = recurrent.plain_networks(weight, readout)
    batch_major = [part.transpose(1, 2) for part in windows.unbind(dim=1)]
    plain = recurrent.plain_pass(networks, batch_major, targets, TINY.warm_up)
    stacked = recurrent.stacked_pass(
        weight.requires_grad_(), readout.requires_grad_(), windows, targets, TINY
    )
    # Ten steps of float32 sums in another order.
    torch.testing.assert_close(plain, stacked, rtol=1e-5, atol=1e-6)
    assert weight.grad is not None
    assert readout.grad is not None
    for m, network in enumerate(networks):
        # The own input of the second half is no parameter: it is always zero there.
        inputs = slice(None) if network.feeds_back else slice(-1)
        own = weight.grad[m, :, TINY.hidden : -1]
        torch.testing.assert_close(
            network.inputs.grad[:, inputs], own[:, inputs], rtol=1e-4, atol=1e-6
        )
        hidden = torch.cat([network.recurrent.grad, network.bias.grad[:, None]], dim=1)
        columns = [*range(TINY.hidden), -1]
        torch.testing.assert_close(hidden, weight.grad[m][:, columns], rtol=1e-4, atol=1e-6)
        emit = torch.cat([network.readout.grad, network.offset.grad[:, None]], dim=1)
        torch.testing.assert_close(emit, readout.grad[m], rtol=1e-4, atol=1e-6)


def test_recurrent_table() -> None:
    header, *rows = cells(recurrent.report("cpu", repetitions=1, passes=1, config=TINY))
    assert header[0] == "training pass"
    assert [row[0] for row in rows] == [
        "plain loop, one network at a time",
        "stacked scan, 4 networks",
    ]
    assert rows[0][-1] == "1.0"


def test_pipeline_table_and_that_it_leaves_a_tracking_server_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = f"sqlite:///{tmp_path}/other.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", other)
    header, *rows = cells(pipeline.report(nodes=2, repetitions=1))
    assert header == ["empty node", "ms per node"]
    assert len(rows) == 3
    assert os.environ["MLFLOW_TRACKING_URI"] == other
    assert not list(tmp_path.iterdir())


def test_all_benchmarks_are_printed_under_their_titles(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    modules = (environment, lanes, recurrent, pipeline)
    for module in modules:
        monkeypatch.setattr(module, "report", lambda name=module.__name__: f"table of {name}")
    all_benchmarks.main()
    printed = capsys.readouterr().out
    assert "PyTorch" in printed.splitlines()[0]
    tables = [f"table of {module.__name__}" for module in modules]
    assert [line for line in printed.splitlines() if line.startswith("table of")] == tables
    assert printed.count("\n## ") == len(modules)
