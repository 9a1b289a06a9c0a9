"""The report of a real sweep over an imported log: judged, never tried, from stored runs alone."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from markupsafe import escape
from matplotlib.figure import Figure

from components.core.files import read_json, write_json
from components.reporting.judged_page import JUDGED_PARTS
from components.reporting.promises import brief, promise
from flows import import_log
from flows.configuration import composition
from flows.configuration.checking import SettingsError
from flows.configuration.settings import load_settings
from flows.pipeline.plan import Plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord
from flows.planning.benchmark import benchmark_plan
from flows.report.__main__ import load_report_settings, report
from flows.report.current import current_report
from flows.report.gather import gather
from flows.report.judged import gather_judged
from flows.report.leads import expected_frames
from tests.browser import visited
from tests.flows.furnace import as_csv, furnace, write_schema
from tests.flows.grid import finished

EVIL = "oxygen<img src=x onerror=alert(1)>"
COMMAND = "python -m flows.full_benchmark profile=smoke sweep=own store=here"
BUDGETS = (
    "profile=smoke",
    "model.recurrent_ensemble.warm_up=10",
    "model.recurrent_ensemble.horizon=10",
    "judging.estimates.updates=20",
)


class Own(NamedTuple):
    """A store with a finished sweep over an imported log, and its plan."""

    store: ArtifactStore
    plan: Plan


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Own]:
    """Two seeds of a policy without λ and of one with it; a column of the log has an evil name."""
    place = tmp_path_factory.mktemp("own")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PROXIMITY_BENCH_HOME", str(place))
        patch.setattr(import_log, "report_figure", lambda dataset: Figure((1, 1)))
        composition.base_layers.cache_clear()
        cells = furnace(8, 90)
        cells[EVIL] = cells.pop("oxygen")
        (place / "log.csv").write_text(as_csv(cells), encoding="utf-8")
        schema = write_schema(place, features=["temperature", EVIL])
        words = [str(place / "log.csv"), "name=furnace", f"schema={schema}"]
        assert import_log.import_log(import_log.load_import_settings(words)) == 0
        chosen = ("datasets=[furnace]", "algorithms=[bc,lion]", "seeds=[0,1]")
        plan = benchmark_plan(load_settings((*BUDGETS, *chosen)))
        store = finished(plan, place / "mlruns")
        SweepRecord.of("own", COMMAND, plan).save(store.root)
        yield Own(store, plan)
    composition.base_layers.cache_clear()


def door(*words: str) -> int:
    return report(load_report_settings(words))


def partial_store(own: Own, place: Path, *gone: str) -> Path:
    """A copy of the store without the nodes whose names begin so."""
    store = place / "mlruns"
    shutil.copytree(own.store.root / "sweeps", store / "sweeps")
    (store / "nodes").mkdir()
    for node in own.plan:
        if not node.name.startswith(gone or ("nothing",)):
            (store / "nodes" / node.key).symlink_to(own.store.root / "nodes" / node.key)
    return store


@pytest.mark.slow(8)
def test_a_page_shows_what_was_judged_and_that_it_was_never_tried(
    own: Own, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(own.store.root.rglob("*"))
    words = (f"store={own.store.root}", f"out={tmp_path}")
    assert door(*words) == 0
    assert door(*words, "format=markdown", "figures=true") == 0
    assert sorted(own.store.root.rglob("*")) == before, "nothing is written there"
    said = capsys.readouterr().out
    assert "Judged from the log alone, never tried." in said
    [log] = gather_judged(own.store, ["own"]).logs
    for sentence in promise(log).first:
        assert sentence in said
        assert sentence in (tmp_path / "report.md").read_text(encoding="utf-8")
        assert escape(sentence) in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "figures=true: judged policies have no figures but those of the page." in said
    assert {p.name for p in tmp_path.iterdir()} == {"report.html", "report.md", "policies.parquet"}
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    for part in ("Nothing here has been tried in reality", "## What it cost", "| lion", EVIL):
        assert part in text, part
    assert "profile=smoke sweep=own\n" in text, "the store's place repeats nothing"


@pytest.mark.slow(1)
def test_its_numbers_are_those_of_the_sweeps_own_tables(own: Own, tmp_path: Path) -> None:
    shown = current_report(tmp_path / "report", own.plan, own.store)
    assert shown.has_page
    assert shown.table is None
    [judged] = gather_judged(own.store, ["own"]).logs
    for line in brief(judged):
        assert line in shown.below
        assert line in (tmp_path / "report" / "results.md").read_text(encoding="utf-8")
    assert door(f"store={own.store.root}", f"out={tmp_path}") == 0
    policies = pd.read_parquet(tmp_path / "policies.parquet")
    assert len(policies) == 2 * (1 + 11)  # seeds, policies without λ and with the judges' grid
    table = pd.read_csv(tmp_path / "report" / "judgements.csv")
    for name in ("model", "fitted_q_error", "outside", "model_error_usual", "score_cautious_0.5"):
        np.testing.assert_allclose(policies[name], table[name], rtol=1e-12)
    names = {node.key: node.name for node in own.plan}
    assert [names[key] for key in policies["policy"]] == policies["run"].tolist()
    [log] = gather_judged(own.store, ["own"]).logs
    selection = pd.read_csv(tmp_path / "report" / "selection.csv")
    assert [c.algorithm for c in log.choices] == selection["algorithm"].tolist()
    assert [c.score for c in log.choices] == pytest.approx(selection["score"].tolist())
    gains = [c.expected.value for c in log.choices]
    assert gains == pytest.approx((selection["model"] - selection["model_usual"]).tolist())


@pytest.mark.slow(1)
def test_where_policies_lead_is_shown_beside_the_log(own: Own, tmp_path: Path) -> None:
    frames = expected_frames(list(own.plan), own.store)
    assert len(frames) == 2 * (1 + 11) * 2  # seeds, policies and λ, columns
    assert (frames["low"] <= frames["high"]).all()
    assert frames.filter(like="held_").stack().between(0.0, 1.0).all()
    assert set(frames["feature"]) == {"temperature", EVIL}
    [split] = [node for node in own.plan if node.name == "data/furnace/judge"]
    logged = np.load(own.store.path(split.key) / "dataset" / "frames.npy")
    for column, name in enumerate(("temperature", EVIL)):
        row = frames[frames["feature"] == name].iloc[0]
        assert (row["least"], row["greatest"]) == pytest.approx(
            (logged[:, column].min(), logged[:, column].max())
        )
    [log] = gather_judged(own.store, ["own"]).logs
    assert all(len(choice.leads) == 2 for choice in log.choices)
    lion = next(c for c in log.choices if c.proximity == 1.0)
    at = (frames["proximity"] == 1.0) & (frames["feature"] == "temperature")
    assert lion.leads[0].high == frames[at]["high"].max()
    current_report(tmp_path / "report", own.plan, own.store)
    written = pd.read_csv(tmp_path / "report" / "frames.csv")
    pd.testing.assert_frame_equal(written, frames, check_dtype=False)  # a log is in float32


@pytest.mark.slow(1)
def test_judgements_of_before_lack_where_policies_lead(own: Own, tmp_path: Path) -> None:
    store = ArtifactStore(partial_store(own, tmp_path, "judge/"))
    for node in own.plan:
        if node.component == "judgement":
            shutil.copytree(own.store.path(node.key), store.path(node.key))
            file = store.path(node.key) / "judgement.npz"
            with np.load(file) as stored:
                old = {n: stored[n] for n in stored.files if "frames" not in n and "held" not in n}
            np.savez(file, **old)
            record = store.path(node.key) / "node.json"
            content = read_json(record)
            write_json(record, {k: v for k, v in content.items() if k not in ("files", "digest")})
    [log] = gather_judged(store, ["own"]).logs
    assert len(log.choices) == 12
    assert not any(choice.leads for choice in log.choices)


@pytest.mark.slow(1)
def test_what_is_not_finished_is_said(own: Own, tmp_path: Path) -> None:
    store = partial_store(own, tmp_path, "judge/lion/furnace/seed1")
    [log] = gather_judged(ArtifactStore(store, create=False), ["own"]).logs
    assert log.progress == ["Not finished: lion: 1 of 2 seeds judged, 2 trained."]
    assert {choice.algorithm: choice.policies for choice in log.choices} == {"bc": 2, "lion": 1}


@pytest.mark.slow(1)
@pytest.mark.parametrize(
    ("gone", "finished"),
    [("judge/", "0 of 4 so far"), ("judge/lion/furnace/seed1", "3 of 4 so far")],
)
def test_a_sweep_that_was_stopped_says_how_much_is_judged(
    own: Own, tmp_path: Path, gone: str, finished: str
) -> None:
    store = ArtifactStore(partial_store(own, tmp_path, gone))
    [note] = [n for n in current_report(tmp_path / "report", own.plan, store).below if "Note" in n]
    assert note == (
        "Note: furnace has no system to evaluate on: its policies are judged from its log alone, "
        f"{finished}; the same command again continues."
    )


@pytest.mark.slow(1)
def test_before_anything_is_judged_there_is_a_page_too(own: Own, tmp_path: Path) -> None:
    store = partial_store(own, tmp_path, "data/furnace", "judge/")
    assert door(f"store={store}", "sweep=own") == 0
    text = (store / "reports" / "own" / "report.html").read_text(encoding="utf-8")
    assert "Not judged yet" in text
    assert "lion: 0 of 2 seeds judged, 0 trained" in text, "without its log nothing counts"


@pytest.mark.slow(1)
def test_sweeps_stand_beside_each_other(own: Own, tmp_path: Path) -> None:
    store = partial_store(own, tmp_path)
    SweepRecord.of("again", COMMAND, own.plan).save(store)
    found = gather_judged(ArtifactStore(store, create=False), ["own", "again"])
    assert [log.name for log in found.logs] == ["furnace · own", "furnace · again"]
    assert set(found.algorithms) == {f"{a} · {s}" for a in ("bc", "lion") for s in ("own", "again")}
    assert len(found.policies) == 2 * 24


def test_latex_is_refused_in_one_sentence(own: Own, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"format=latex .* format=markdown has the tables"):
        door(f"store={own.store.root}", f"out={tmp_path}", "format=latex")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow(15)
def test_in_a_sweep_of_both_kinds_judged_logs_are_a_part_of_the_page(
    own: Own, tmp_path: Path
) -> None:
    chosen = ("datasets=[furnace,bad-0.4]", "algorithms=[bc]", "seeds=[0,1]")
    plan = benchmark_plan(load_settings((*BUDGETS, *chosen)))
    root = partial_store(own, tmp_path)
    finished(plan, root)
    SweepRecord.of("both", "python -m both", plan).save(root)
    found = gather(ArtifactStore(root, create=False), ["both"])
    assert list(found.table.logged) == ["bad-0.4"]
    assert [log.dataset for log in found.judged] == ["furnace"]
    for kind in ("html", "markdown"):
        assert door(f"store={root}", "sweep=both", f"out={tmp_path}", f"format={kind}") == 0
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "## Logs without a real system" in text
    assert set(pd.read_parquet(tmp_path / "policies.parquet")["dataset"]) == {"bad-0.4"}
    judged = pd.read_parquet(tmp_path / "judged.parquet")
    assert set(judged["dataset"]) == {"furnace"}
    for row in judged.to_dict("records"):
        record = ArtifactStore(root, create=False).record(row["policy"])
        assert (row["run"], row["hardware"]) == (record["name"], record["hardware"])
        assert row["commit"] == record["commit"]
    with visited((tmp_path / "report.html").as_uri()) as visit:
        visit.page.wait_for_selector("body[data-ready]")
        assert visit.page.locator("#judged .card h3").all_inner_texts() == ["furnace"]
        assert visit.page.locator("#verdicts .card h3").all_inner_texts() == ["bad-0.4"]
        assert visit.page.locator("#figure-judged-0 .main-svg").count()
        assert visit.complaints == []


@pytest.mark.slow(8)
@pytest.mark.parametrize("gone", [("aggregate/",), ("",)])
def test_a_sweep_of_both_kinds_has_a_page_before_anything_is_tried(
    own: Own, tmp_path: Path, capsys: pytest.CaptureFixture[str], gone: tuple[str, ...]
) -> None:
    chosen = ("datasets=[furnace,bad-0.4]", "algorithms=[bc]", "seeds=[0,1]")
    plan = benchmark_plan(load_settings((*BUDGETS, *chosen)))
    root = partial_store(own, tmp_path, *gone)
    SweepRecord.of("both", "python -m both", plan).save(root)
    for kind in ("html", "markdown", "latex"):
        assert door(f"store={root}", "sweep=both", f"out={tmp_path}", f"format={kind}") == 0
    assert "0 of 1 cells of the table are finished." in capsys.readouterr().out
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "## Logs without a real system" in text
    assert "- bc on bad-0.4: 0 of 2 seeds evaluated" in text
    assert ("0 of 2 seeds judged" in text) == (gone == ("",))
    with visited((tmp_path / "report.html").as_uri()) as visit:
        visit.page.wait_for_selector("body[data-ready]")
        assert "0 of 2 seeds evaluated" in visit.page.inner_text("body")
        assert visit.page.locator("#judged .card h3").all_inner_texts() == ["furnace"]
        assert visit.complaints == []


@pytest.mark.slow(8)
def test_a_browser_shows_it_without_a_network(own: Own, tmp_path: Path) -> None:
    assert door(f"store={own.store.root}", f"out={tmp_path}") == 0
    address = (tmp_path / "report.html").as_uri()
    assert EVIL not in (tmp_path / "report.html").read_text(encoding="utf-8")
    with visited(address) as visit:
        for width in (1400, 400):
            visit.page.set_viewport_size({"width": width, "height": 900})
            visit.page.reload()
            visit.page.wait_for_selector("body[data-ready]")
            assert visit.page.evaluate("document.documentElement.scrollWidth") <= width
            for part, _ in JUDGED_PARTS:
                assert visit.page.is_visible(f"section#{part} h2"), part
            box = visit.page.locator("#figure-judged-0 .main-svg").first.bounding_box()
            assert box is not None
            assert 300 < box["width"] <= width
        assert EVIL in visit.page.inner_text("#logs"), "as text"
        drawn = "document.getElementById('figure-judged-0').data"
        names = visit.page.evaluate(f"{drawn}.map(t => t.name)")
        assert {"lion, ensemble", "lion, critics", "lion, outside"} <= set(names)
        at = names.index("lion, ensemble")
        assert len(visit.page.evaluate(f"{drawn}[{at}].y")) == 11
        assert all(x > 0 for x in visit.page.evaluate(f"{drawn}[{at}].error_y.array"))
        visit.page.click("[data-toggle='lion']")
        assert "lion, ensemble" not in visit.page.evaluate(f"{drawn}.map(t => t.name)")
        assert set(visit.requests) == {address}
        assert visit.complaints == []
