"""The report's door on a real sweep's store: from stored runs alone, whole or partial."""

import shutil
from pathlib import Path

import pandas as pd
import pytest

from components.core.files import read_json
from components.core.integrity import DamagedFileError
from components.reporting.tables import read_results
from flows.configuration.checking import SettingsError
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord, read_sweep
from flows.report.__main__ import HELP, ReportSettings, load_report_settings, report
from flows.report.gather import gather
from tests.conftest import SmokeRun


def door(*words: str) -> int:
    return report(load_report_settings(words))


def partial_store(smoke: SmokeRun, place: Path, *gone: str) -> Path:
    """A copy of the smoke run's store without the nodes of these names."""
    store = place / "mlruns"
    shutil.copytree(smoke.store / "sweeps", store / "sweeps")
    (store / "nodes").mkdir()
    nodes = read_sweep(store / "sweeps" / "smoke.json").nodes
    for key, name in nodes.items():
        if name not in gone:
            (store / "nodes" / key).symlink_to(smoke.store / "nodes" / key)
    return store


def test_all_formats_are_made_of_the_store_alone(
    smoke: SmokeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    before = sorted(smoke.store.rglob("*"))
    words = (f"store={smoke.store}", f"out={out}")
    for kind in ("html", "markdown", "latex"):
        assert door(*words, f"format={kind}") == 0
    assert sorted(smoke.store.rglob("*")) == before, "nothing is written there"
    assert "15 of 15 cells of the table are finished." in capsys.readouterr().out
    names = {path.name for path in out.iterdir()}
    assert names == {"report.html", "report.md", "report.tex", "policies.parquet"}
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "What it cost" in page
    assert "No value of the thesis stands beside returns of 20 steps" in page


def test_the_numbers_are_those_of_the_sweeps_own_table(smoke: SmokeRun, tmp_path: Path) -> None:
    assert door(f"store={smoke.store}", f"out={tmp_path}") == 0
    policies = pd.read_parquet(tmp_path / "policies.parquet")
    assert len(policies) == 2 * 4 * (12 + 3 * 3)  # seeds, snapshots, policies with three λ or none
    table = read_results(smoke.store / "reports" / "smoke" / "results.csv")
    for (_, seed), key in policies.groupby(["algorithm", "seed"])["configuration"].unique().items():
        [node] = key
        record = read_json(smoke.store / "nodes" / node / "node.json")
        assert (record["component"], record["tags"]["seed"]) == ("policy_training", str(seed))
        assert set(policies[policies["configuration"] == node]["hardware"]) == {record["hardware"]}
        assert set(policies[policies["configuration"] == node]["commit"]) == {record["commit"]}
    assert table["thesis_tenth_percentile"].isna().all(), "the thesis counts 100 steps, not 20"
    pooled = policies[policies["pooled"]].fillna({"proximity": -1.0})
    means = pooled.groupby(["algorithm", "proximity"])["return"].mean()
    stored = table.fillna({"proximity": -1.0}).set_index(["algorithm", "proximity"])["mean"]
    assert means.to_dict() == pytest.approx(stored.to_dict(), rel=1e-12)
    found = gather(ArtifactStore(smoke.store, create=False), ["smoke"])
    shown = {c.heading: v for (_, c), v in found.table.cells.items()}
    [row] = table[table["algorithm"] == "td3_bc"].to_dict("records")
    assert shown["td3_bc"].value == row["tenth_percentile"]
    assert shown["td3_bc"].interval == (row["interval_low"], row["interval_high"])


def test_a_partial_sweep_has_gaps(smoke: SmokeRun, tmp_path: Path) -> None:
    pair = "td3_bc/mediocre-0.2"
    gone = (f"aggregate/{pair}", f"evaluate/{pair}/seed1")
    store = partial_store(smoke, tmp_path, *gone, "aggregate/bc/mediocre-0.2")
    found = gather(ArtifactStore(store, create=False), ["smoke"])
    assert {(gap.algorithm, gap.why) for gap in found.gaps} == {
        ("td3_bc", "1 of 2 seeds evaluated"),
        ("bc", "2 of 2 seeds evaluated"),
    }
    assert len(found.cells) == 13
    assert {"td3_bc", "bc"} <= {column.algorithm for column in found.table.columns}
    assert found.across is not None
    assert "td3_bc" not in {column.algorithm for column in found.across.columns}


def test_nodes_whose_inputs_are_gone_count_as_missing(smoke: SmokeRun, tmp_path: Path) -> None:
    store = partial_store(smoke, tmp_path, "data/mediocre-0.2")
    with pytest.raises(SettingsError, match="no dataset and algorithm is finished with all seeds"):
        gather(ArtifactStore(store, create=False), ["smoke"])


def test_two_sweeps_stand_beside_each_other(smoke: SmokeRun, tmp_path: Path) -> None:
    store = partial_store(smoke, tmp_path)
    record = read_sweep(store / "sweeps" / "smoke.json")
    SweepRecord("again", "python -m again", record.nodes).save(store)
    assert door(f"store={store}", "sweep=[smoke,again]") == 0
    assert (store / "reports" / "smoke-and-again" / "report.html").is_file()
    found = gather(ArtifactStore(store, create=False), ["smoke", "again"])
    assert found.algorithms[:2] == ["bc · smoke", "bcq · smoke"]
    assert len(found.cells) == 30
    assert found.sweeps["smoke"] == "python -m flows.full_benchmark profile=smoke sweep=smoke"
    assert found.sweeps["again"] == "python -m again"


def test_figures_are_written_for_print(smoke: SmokeRun, tmp_path: Path) -> None:
    assert door(f"store={smoke.store}", f"out={tmp_path}", "format=markdown", "figures=true") == 0
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    for name in (
        "curves-mediocre-0.2",
        "lambda-mediocre-0.2",
        "performance-profiles",
        "mean-ranks",
    ):
        assert {f"{name}.svg", f"{name}.pdf"} <= names
    drawn = (tmp_path / "figures" / "curves-mediocre-0.2.svg").read_text(encoding="utf-8")
    assert "<!-- mediocre-0.2 (profile smoke, 2 seeds) -->" in drawn


def test_damage_is_named(smoke: SmokeRun, tmp_path: Path) -> None:
    store = partial_store(smoke, tmp_path)
    nodes = read_sweep(store / "sweeps" / "smoke.json").nodes
    key = next(key for key, name in nodes.items() if name == "evaluate/bc/mediocre-0.2/seed0")
    link = store / "nodes" / key
    whole = link.resolve()
    link.unlink()
    shutil.copytree(whole, link)
    (link / "returns.npz").write_bytes(b"x")
    with pytest.raises(DamagedFileError, match=r"returns\.npz is damaged"):
        door(f"store={store}", "sweep=smoke")
    assert not (store / "reports").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["sweep=other"], r"sweep=other: .* has no such sweep; there are: smoke\."),
        (["sweep=[smoke,smoke]"], r"must name sweeps, each once"),
        (["sweep="], r"must name sweeps, each once"),
        (["sweep=smoke", "sweep=smoke"], r"sweep is given twice"),
        (["format=word"], r"format='?word.*html"),
        (["swep=smoke"], r"Unknown key 'swep'; .*sweep"),
        (["smoke"], r"'smoke' is not an override; write key=value"),
    ],
)
def test_what_is_not_understood_is_said(
    smoke: SmokeRun, tmp_path: Path, words: list[str], says: str
) -> None:
    with pytest.raises(SettingsError, match=says):
        door(f"store={smoke.store}", f"out={tmp_path}", *words)
    assert not list(tmp_path.iterdir())


def test_a_store_without_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="holds no runs; give the folder that a sweep has made"):
        door(f"store={tmp_path}")


def test_of_several_sweeps_one_has_to_be_named(smoke: SmokeRun, tmp_path: Path) -> None:
    store = partial_store(smoke, tmp_path)
    record = read_sweep(store / "sweeps" / "smoke.json")
    SweepRecord("search", "python -m flows.tune_models", {"0" * 32: "trial0"}).save(store)
    assert door(f"store={store}", "format=latex") == 0  # a search has no cells to report
    SweepRecord("again", "again", record.nodes).save(store)
    with pytest.raises(SettingsError, match=r"e\.g\. sweep=NAME; there are again, smoke\."):
        door(f"store={store}")


def test_a_sweep_that_neither_tries_nor_judges_is_named(smoke: SmokeRun, tmp_path: Path) -> None:
    store = partial_store(smoke, tmp_path)
    (store / "sweeps" / "smoke.json").unlink()
    SweepRecord("pump", "again", {"0" * 32: "bc/pump/seed0"}).save(store)
    with pytest.raises(SettingsError, match="none of pump evaluates or judges policies"):
        door(f"store={store}")
    with pytest.raises(SettingsError, match=r"neither evaluated nor judged.*reports/pump holds"):
        door(f"store={store}", "sweep=pump")


def test_help_names_every_setting() -> None:
    for name in ReportSettings.model_fields:
        assert f"\n  {name}=" in HELP
