"""The door that ranks datasets: what it writes, what it reads of a sweep, what it refuses."""

import dataclasses
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from components.core.files import write_text
from components.data.indicators import log_facts
from components.data.sources.stored_log import StoredLog
from components.reporting.ranking import thesis_ranks
from components.reporting.stored import ReportNodes
from components.reporting.tables import result_table, results_csv
from flows import rank_datasets
from flows.command_line import main
from flows.configuration.checking import SettingsError
from flows.configuration.settings import load_settings
from flows.planning.ranking import ranking_plan
from flows.report.achieved import Achieved, achieved
from tests.components.synthetic import make_log, relabelled
from tests.flows.grid import overridden

SMALL = [
    "profile=smoke", "datasets=[bad-0.4,mediocre-0.2,optimized-0.6]", "data.trajectories=11",
    "data.steps=110", "ranking.stochasticity.updates=10", "ranking.stochasticity.hidden=[8]",
    "clips=[0.9,0.99]",
]  # fmt: skip


def door(monkeypatch: pytest.MonkeyPatch, store: Path, *words: str) -> int:
    """The exit code of the command."""
    fixed = ["runner.executor=serial", "runner.tracker=file", f"store={store}"]
    monkeypatch.setattr(sys, "argv", ["rank_datasets", *fixed, *words])
    with pytest.raises(SystemExit) as ended:
        main("rank_datasets", rank_datasets.HELP, rank_datasets._run, rank_datasets.ALIASES)
    return int(ended.value.code or 0)


def data_keys(*words: str) -> dict[str, str]:
    """The keys of the datasets of a command."""
    plan = ranking_plan(load_settings([*SMALL, *words], rank_datasets.ALIASES))
    return {n.tags["dataset"]: n.key for n in plan if n.component == "data_generation"}


def write_report(store: Path, name: str, datasets: dict[str, str], **percentiles: Any) -> None:
    """The report of a sweep: by algorithm, 10th percentiles of all datasets, over proximities."""
    summaries = []
    for dataset in datasets:
        for algorithm, values in percentiles.items():
            numbers = dict.fromkeys(["standard_error", "mean", "std", "iqm"], 0.0)
            points = [
                {"lambda": at, "policies": 2, "tenth_percentile": value, **numbers}
                for at, value in values.items()
            ]
            row = {"dataset": dataset, "algorithm": algorithm, "seeds": [0], "points": points}
            summaries.append(row)
    folder = store / "reports" / name
    folder.mkdir(parents=True)
    write_text(folder / "results.csv", results_csv(result_table(summaries)))
    ReportNodes((), datasets).save(folder)


@pytest.mark.slow(6)
def test_a_ranking_beside_the_results_of_a_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert door(monkeypatch, tmp_path, *SMALL, "dry_run=true") == 0
    assert list(tmp_path.iterdir()) == []
    write_report(tmp_path, "full", data_keys(), moose={None: -60.0}, lion={0.0: -80.0, 0.5: -70.0})
    write_report(tmp_path, "other-data", data_keys("data.seed=1"), moose={None: -1.0})
    assert door(monkeypatch, tmp_path, *SMALL, "algorithm=lion") == 0
    [folder] = tmp_path.glob("reports/ranking-*")
    assert sorted(path.name for path in folder.iterdir()) == sorted(rank_datasets._FILES)
    table = pd.read_csv(folder / "ranking.csv").set_index("dataset")
    mean, floor = table["return_mean"], table["return_floor"]
    assert (floor == -350.0).all()
    assert table["tri"].to_numpy() == pytest.approx(((-70.0 - mean) / (mean + 350.0)).to_numpy())
    assert table["eri"].to_numpy() == pytest.approx(
        ((table["return_max"] - mean) / (mean + 350.0)).to_numpy()
    )
    clips = pd.read_csv(folder / "eas_over_clips.csv").set_index("clip")
    assert clips.index.tolist() == [0.9, 0.99]
    for name in table.index:
        assert clips.loc[0.9, name] == table.loc[name, "eas"]
    said = capsys.readouterr().out
    assert "TRI is the improvement by lion at its best λ, in the sweep full." in said
    assert "true improvement by moose" in said
    assert "Ranks count from 1, the least" in said
    head, _, *rows = [line for line in said.splitlines() if line.startswith("| ")][:5]
    at = [cell.strip() for cell in head.split("|")].index("COI rank")
    assert [int(row.split("|")[at]) for row in rows] == [3, 2, 1]
    alone = rank_datasets._shown(table.reset_index().head(1))
    assert "ERI" in alone
    assert "rank" not in alone, "a single log has none"
    assert said.count("First guess of λ: 0.00 to ") == 3
    assert (folder / "ranking.md").read_text(encoding="utf-8").strip() in said
    [record] = tmp_path.glob("tracking/ranking-*.jsonl")
    assert '"eas/bad-0.4"' in record.read_text(encoding="utf-8")

    # Another floor needs no new fit; one that returns fall below is refused.
    fitted = sorted((tmp_path / "nodes").iterdir())
    assert door(monkeypatch, tmp_path, *SMALL, "floor=-400") == 0
    assert (pd.read_csv(folder / "ranking.csv")["return_floor"] == -400.0).all()
    assert sorted((tmp_path / "nodes").iterdir()) == fitted
    capsys.readouterr()
    assert door(monkeypatch, tmp_path, *SMALL, "floor=-100") == 2
    assert "below the floor of -100; give a floor that none falls below." in capsys.readouterr().err


@pytest.mark.slow(3)
def test_logs_of_ones_own_without_a_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One of a single episode, one of equal rewards and constant actions, one that cannot be."""
    usual = make_log(episodes=12, steps=30)
    equal = make_log(episodes=12, steps=30, seed=1)
    equal = relabelled(
        equal, rewards=np.ones_like(equal.rewards), actions=np.zeros_like(equal.actions)
    )
    single, tiny = make_log(episodes=1, steps=60), make_log(episodes=1, steps=1)
    logs = {"usual": usual, "equal": equal, "single": single, "tiny": tiny}
    for name, log in logs.items():
        card = dataclasses.replace(log.card, name=name)
        dataclasses.replace(log, card=card).write(tmp_path / "logs" / name)
    load = load_settings

    def with_logs(words: list[str], aliases: Any) -> Any:
        settings = load(words, aliases)
        sources = {name: StoredLog(name, str(tmp_path / "logs" / name)) for name in logs}
        return settings.model_copy(update={"dataset": sources, "datasets": tuple(sources)})

    monkeypatch.setattr("flows.command_line.load_settings", with_logs)
    small = [word for word in SMALL if not word.startswith("datasets")]
    assert door(monkeypatch, tmp_path / "store", *small) == 1
    out, err = capsys.readouterr()
    assert "tiny cannot be ranked: tiny has a single transition, which has no spread." in err
    [folder] = (tmp_path / "store").glob("reports/ranking-*")
    table = pd.read_csv(folder / "ranking.csv").set_index("dataset")
    assert sorted(table.index) == ["equal", "single", "usual"]
    assert table.loc["equal", "eri"] == table.loc["single", "eri"] == 0.0
    assert "all episodes have the same return" in table.loc["equal", "limit"]
    assert "narrow actions (every action" in table.loc["equal", "limit"]
    assert "a single episode of 60 steps" in table.loc["single", "limit"]
    assert table.loc["usual", "return_floor"] == pytest.approx(log_facts(usual).return_min)
    assert "thesis" not in out.partition("EAS depends")[0]
    assert "nan" not in out


def test_which_sweep_is_read(tmp_path: Path) -> None:
    keys = data_keys()
    assert achieved(tmp_path, keys, None) == Achieved("", {})
    with pytest.raises(SettingsError, match=r"report=full: .* has no such report; there is none"):
        achieved(tmp_path, keys, "full")
    write_report(tmp_path, "full", keys, bc={None: -60.0}, lion={0.0: -80.0, 0.5: -70.0})
    found = achieved(tmp_path, keys, None)
    assert found.sweep == "full"
    assert found.percentiles["bad-0.4"] == {"bc": -60.0, "lion at its best λ": -70.0}
    assert found.algorithm(None) == "bc"
    assert found.algorithm("lion") == "lion at its best λ"
    with pytest.raises(SettingsError, match=r"algorithm=mopo: no result of it; has bc, lion at"):
        found.algorithm("mopo")
    # Equal names, other data.
    assert achieved(tmp_path, data_keys("data.seed=1"), None) == Achieved("", {})
    with pytest.raises(SettingsError, match="report=full has no results on these datasets"):
        achieved(tmp_path, data_keys("data.seed=1"), "full")
    # A damaged report of another sweep is passed over unless it is asked for.
    write_report(tmp_path, "broken", keys, bc={None: -60.0})
    (tmp_path / "reports" / "broken" / "report.json").write_text("{", encoding="utf-8")
    assert achieved(tmp_path, keys, None) == found
    with pytest.raises(ValueError, match="broken"):
        achieved(tmp_path, keys, "broken")
    write_report(tmp_path, "second", keys, moose={None: -60.0})
    several = achieved(tmp_path, keys, None)
    assert several.percentiles == {}
    assert several.note.startswith("Several sweeps have results on these datasets: full, second;")
    assert achieved(tmp_path, keys, "second").algorithm(None) == "moose"


def test_the_floor_is_no_part_of_what_is_measured() -> None:
    def keys(*words: str) -> list[str]:
        plan = ranking_plan(load_settings([*SMALL, *words], rank_datasets.ALIASES))
        return [node.key for node in plan if node.component == "indicators"]

    assert keys("floor=-400", "report=x", "algorithm=lion") == keys()
    assert not set(keys("clip=0.95")) & set(keys())


def test_the_sixteen_have_a_profile() -> None:
    settings = load_settings(["profile=chapter4"])
    assert set(settings.datasets) == set(thesis_ranks().index)


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("clip=1.5", "clip and clips must lie in"),
        ("clips=[0.5,1]", "clip and clips must lie in"),
        ("floor=low", "ranking.floor"),
        ("algorithm=lion", "ranking.algorithm=lion: no result of it; there is no sweep"),
        ("report=none", "report=none: .* has no such report"),
    ],
)
def test_bad_input(
    word: str,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    small = overridden(SMALL, [word])
    assert door(monkeypatch, tmp_path / "mlruns", *small) == 2
    error = capsys.readouterr().err
    assert re.search(says, error)
    assert len(error.strip().splitlines()) == 1
    assert not (tmp_path / "mlruns" / "nodes").exists()
