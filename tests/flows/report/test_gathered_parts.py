"""Parts of a report: costs, software, rankings and selections of other doors."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from flows.pipeline.sweep_records import SweepRecord
from flows.report.costs import cost_table, software_table
from flows.report.other_tables import guesses_of, judges_of, ranking_of, selection_of
from flows.report.stored_nodes import StoredNode


def node(component: str, name: str, seconds: float = 60.0, **record: Any) -> StoredNode:
    tags = {"model": name.split("/")[0]} if component == "model_fitting" else {}
    return StoredNode(name, name, component, {}, {}, tags, {"seconds": seconds, **record})


def test_costs_are_by_work_and_label_the_dearest_first() -> None:
    nodes = [
        node("policy_training", "bc/a/seed0", 1800.0, peak_rss_mib=1024.0, device="cpu"),
        node("policy_training", "bc/a/seed1", 1800.0, peak_rss_mib=2048.0, device="cuda"),
        node("policy_training", "lion/a/seed0", 7200.0),
        node("evaluation", "evaluate/bc/a/seed0"),
        node("judgement", "judge/bc/a/seed0"),
        node("model_fitting", "behaviour_policy/a"),
        node("aggregation", "aggregate/bc/a"),
    ]
    table = cost_table({"": nodes})
    assert list(zip(table["work"], table["of"], strict=True)) == [
        ("model", "behaviour_policy"),
        ("training", "lion"),
        ("training", "bc"),
        ("evaluation", "bc"),
        ("judging", "bc"),
    ]
    bc = table[(table["work"] == "training") & (table["of"] == "bc")].to_dict("records")[0]
    assert (bc["runs"], bc["hours"], bc["minutes a run"]) == (2, 1.0, 30.0)
    assert (bc["memory (GiB)"], bc["device"]) == (2.0, "cpu, cuda")
    both = cost_table({" · new": nodes[:1], " · old": nodes[1:2]})
    assert both["of"].tolist() == ["bc · new", "bc · old"]


def test_software_is_counted_by_combination() -> None:
    known = {"software": {"torch": "2.13.0", "device": "EPYC"}, "package": "0.1.0"}
    table = software_table([node("a", "x", **known), node("a", "y", **known), node("a", "z")])
    assert table["nodes"].tolist() == [2, 1]
    assert table["torch"].tolist() == ["2.13.0", ""]
    assert table["computer"].tolist() == ["unknown", "unknown"]


def write(folder: Path, name: str, **columns: Any) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(columns).to_csv(folder / name, index=False)


def test_a_ranking_of_the_same_logs_is_found_and_of_others_is_not(tmp_path: Path) -> None:
    for name, keys, eri in (("some", {"k1": "data/a"}, 1.0), ("others", {"x": "data/a"}, 9.0)):
        write(tmp_path / "reports" / f"ranking-{name}", "ranking.csv", dataset=["a", "b"], eri=eri)
        SweepRecord(f"ranking-{name}", "rank", keys).save(tmp_path)
    found = ranking_of(tmp_path, {"a": "k1", "b": "k2"})
    assert found is not None
    assert found.to_dict("records") == [{"dataset": "a", "eri": 1.0}], "b was another log there"
    more = {"k1": "data/a", "k2": "data/b"}
    write(tmp_path / "reports" / "ranking-more", "ranking.csv", dataset=["a", "b"], eri=2.0)
    SweepRecord("ranking-more", "rank", more).save(tmp_path)
    found = ranking_of(tmp_path, {"a": "k1", "b": "k2"})
    assert found is not None
    assert found["eri"].tolist() == [2.0, 2.0]
    assert ranking_of(tmp_path, {"a": "k3"}) is None


def test_the_first_guess_of_a_ranking_is_that_of_the_same_log(tmp_path: Path) -> None:
    columns = {"dataset": ["a", "b"], "proximity_from": [0.0, 0.0], "proximity_to": [0.05, 0.3]}
    write(tmp_path / "reports" / "ranking", "ranking.csv", **columns)
    SweepRecord("ranking", "rank", {"k1": "data/a", "k2": "data/b"}).save(tmp_path)
    assert guesses_of(tmp_path, {"a": "k1", "b": "other"}) == {"a": (0.0, 0.05)}
    assert guesses_of(tmp_path, {"a": "other"}) == {}


@pytest.mark.parametrize("sweeps", [["s"], ["s", "t"]])
def test_what_judges_chose_is_read_where_it_was_written(tmp_path: Path, sweeps: list[str]) -> None:
    assert selection_of(tmp_path, sweeps) is None
    assert judges_of(tmp_path, sweeps) is None
    folder = tmp_path / "reports" / "s"
    score = [9.0, 8.0, 7.0, 6.0, 1.0]
    write(folder, "selection.csv", dataset=[*"aaaab"], algorithm="bc", score=score, model_error=0.1)
    write(
        folder, "judges.csv", score=["m", "q"] * 2, dataset=[*"aabb"], regret_1=[0.0, 2.0, 4.0, 8.0]
    )
    found, judges = selection_of(tmp_path, sweeps), judges_of(tmp_path, sweeps)
    assert found is not None
    assert judges is not None
    assert found["score"].tolist() == [9.0, 8.0, 7.0, 1.0]
    assert ("sweep" in found) == (len(sweeps) > 1)
    assert "model_error" not in found
    assert judges.to_dict("records") == [
        {"score": "m", "regret_1": 2.0},
        {"score": "q", "regret_1": 5.0},
    ]
