"""Logs that can be used: what is stored, what is said about it, and that it is a dataset."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from matplotlib.figure import Figure

from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification
from components.data.imports.report import report_figure
from flows import import_log as door
from flows.configuration import composition, files, schema
from flows.configuration.settings import SettingsError, load_settings
from flows.import_log import import_log, load_import_settings
from flows.planning.benchmark import benchmark_plan
from tests.components.synthetic import make_log
from tests.flows.furnace import EPISODES, ROWS, Cells, as_csv, furnace, imported, put, write_schema
from tests.flows.grid import finished


def column(cells: Cells, name: str) -> np.ndarray:
    return np.array(cells[name], np.float32).reshape(EPISODES, -1)


def test_rows_become_frames_and_all_but_the_last_row_transitions(project: Path) -> None:
    cells = furnace()
    log = imported(cells)
    assert (log.episodes, log.transitions) == (EPISODES, EPISODES * (ROWS - 1))
    frames = log.frames.reshape(EPISODES, ROWS, 2)
    np.testing.assert_array_equal(frames[..., 0], column(cells, "temperature"))
    np.testing.assert_array_equal(frames[..., 1], column(cells, "oxygen"))
    gas = column(cells, "gas")[:, :-1] / 50 - 1
    np.testing.assert_allclose(log.actions.reshape(EPISODES, -1, 2)[..., 0], gas, atol=2e-7)
    # outcome_row: after; the profit of a state stands in its row
    np.testing.assert_array_equal(log.rewards.reshape(EPISODES, -1), column(cells, "profit")[:, 1:])
    assert log.truncated.sum() == EPISODES
    assert not log.terminated.any()


def test_the_card_keeps_the_bounds_by_which_actions_scale_back(project: Path) -> None:
    cells = furnace()
    log = imported(cells)
    assert log.card.action_features == ("gas", "air")
    assert log.card.action_bounds == ((0.0, 100.0), (0.0, 50.0))
    assert (log.card.history, log.card.discount, log.card.sampling) == (4, 0.97, 10.0)
    low, high = np.array(log.card.action_bounds, np.float32).T
    back = low + (log.actions + 1) / 2 * (high - low)
    logged = np.stack([column(cells, name)[:, :-1].ravel() for name in ("gas", "air")], axis=1)
    np.testing.assert_allclose(back, logged, atol=1e-5)  # rounding of single precision at 100
    dynamics = DynamicsSpecification.of_card(log.card)
    assert dynamics.known == ("gas", "air")
    assert dynamics.learned == ("temperature", "oxygen", "reward")


def test_the_folder_holds_a_report_and_conf_names_it(
    project: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(door, "report_figure", report_figure)
    imported(furnace())
    folder = project / "logs" / "furnace"
    report = (folder / "report.md").read_text(encoding="utf-8")
    assert "180 rows became 174 transitions in 6 episodes of 29 to 29 steps" in report
    assert "no real system" in report
    assert "| gas | action | 0 ... 100 became -1 ... 1 | 10" in report
    assert (folder / "report.png").stat().st_size > 10_000
    assert (folder / "schema.yaml").read_bytes() == Path("furnace.yaml").read_bytes()
    named = (project / "conf" / "dataset" / "furnace.yaml").read_text(encoding="utf-8")
    assert yaml.safe_load(named) == {"furnace": {"domain": "plant", "log": "logs/furnace"}}
    assert "datasets=[furnace]" in capsys.readouterr().out
    assert [path.name for path in (project / "logs").iterdir()] == ["furnace"]


def test_with_a_folder_of_ones_own_everything_is_there(
    project: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    own = tmp_path_factory.mktemp("own")
    monkeypatch.setenv(files.HOME, str(own))
    Path("log.csv").write_text(as_csv(furnace()), encoding="utf-8")
    write_schema(project)
    words = ["log.csv", "name=furnace", "replace=true"]
    for _ in range(2):
        assert import_log(load_import_settings(words)) == 0
    said = capsys.readouterr().out
    assert f"{own}/logs/furnace has them; read {own}/logs/furnace/report.md" in said  # to be pasted
    assert OfflineDataset.open(own / "logs" / "furnace").card.name == "furnace"
    named = (own / "conf" / "dataset" / "furnace.yaml").read_text(encoding="utf-8")
    assert yaml.safe_load(named)["furnace"]["log"] == "logs/furnace"
    assert not (project / "logs").exists()
    (project / "conf" / "dataset" / "taken.yaml").touch()
    write_schema(project).rename("taken.yaml")
    with pytest.raises(SettingsError, match="name=taken is that of a dataset of this project"):
        import_log(load_import_settings(["log.csv", "name=taken"]))


def test_the_same_log_is_the_same_dataset_from_any_kind_of_file(project: Path) -> None:
    cells = furnace()
    digest = imported(cells).card.digest
    numbers = {n: np.array(v, np.float64) for n, v in cells.items() if n not in ("run", "time")}
    stamps = np.array(cells["time"], "datetime64[ms]")
    table = pa.table({**numbers, "run": np.array(cells["run"], int), "time": stamps})
    folder = project / "parts"
    folder.mkdir()
    pq.write_table(table[:70], folder / "part-9.parquet")  # in the middle of an episode
    pq.write_table(table[70:], folder / "part-10.parquet")
    (folder / "_SUCCESS").touch()
    assert import_log(load_import_settings(["parts", "name=furnace", "replace=true"])) == 0
    assert OfflineDataset.open(project / "logs" / "furnace").card.digest == digest
    german = as_csv({n: [v.replace(".", ",") for v in c] for n, c in cells.items()}, ";")
    (project / "german.csv").write_bytes(german.encode("utf-8-sig"))
    write_schema(project, delimiter=";", decimal=",")
    assert import_log(load_import_settings(["german.csv", "name=furnace", "replace=true"])) == 0
    assert OfflineDataset.open(project / "logs" / "furnace").card.digest == digest


def test_times_with_zones_numbers_and_jitter(project: Path) -> None:
    cells = furnace()
    digest = imported(cells).card.digest
    for times, changes in (
        ([f"{time}+02:00" for time in cells["time"]], {}),
        ([str(60 * row + row % 3) for row in range(EPISODES * ROWS)], {"sampling": 60}),
    ):
        log = imported({**cells, "time": times}, "replace=true", **changes)
        assert log.card.digest == digest


def test_missing_values_are_filled_in_or_their_episodes_left_out(project: Path) -> None:
    cells = furnace()
    for row in (17, 18):
        put("oxygen", row, "")(cells)
    put("gas", 40, "inf")(cells)
    log = imported(cells, "missing=forward_fill")
    oxygen = log.frames[:ROWS, 1]
    assert oxygen[15] == oxygen[16] == oxygen[14]
    report = Path("logs/furnace/report.md").read_text(encoding="utf-8")
    assert "- Missing values repeat the row before: 2 of oxygen, 1 of gas." in report
    log = imported(cells, "missing=drop_episode", "replace=true")
    assert log.episodes == EPISODES - 2
    np.testing.assert_array_equal(
        log.frames[:, 0].reshape(-1, ROWS), column(furnace(), "temperature")[2:]
    )
    report = Path("logs/furnace/report.md").read_text(encoding="utf-8")
    assert "- 2 of 6 episodes are left out" in report
    put("oxygen", 2, "")(cells)
    with pytest.raises(SettingsError, match=r"row 2: 'oxygen' is missing, and its episode has no"):
        imported(cells, "missing=forward_fill", "replace=true")


def test_what_a_historian_writes_for_no_value_is_missing(project: Path) -> None:
    cells = furnace()
    digest = []
    for code in ("", "Bad Input", "-9999.00"):
        put("oxygen", 17, code)(cells)
        words = ["missing=forward_fill", "replace=true"]
        log = imported(cells, *words, na_values=["Bad Input", -9999])
        digest.append(log.card.digest)
    assert len({*digest}) == 1
    report = Path("logs/furnace/report.md").read_text(encoding="utf-8")
    assert "- Missing values repeat the row before: 1 of oxygen." in report
    with pytest.raises(SettingsError, match="row 17: 'oxygen' is missing"):
        imported(cells, "replace=true", na_values=[-9999])


def test_times_in_a_format_of_their_own(project: Path) -> None:
    cells = furnace()
    digest = imported(cells).card.digest
    cells["time"] = [f"{t[8:10]}.{t[5:7]}.{t[:4]} {t[11:]}.25" for t in cells["time"]]
    form = {"time_format": "%d.%m.%Y %H:%M:%S.%f"}
    assert imported(cells, "replace=true", **form).card.digest == digest
    cells["time"] = [f"{time} +0200" for time in cells["time"]]
    form = {"time_format": "%d.%m.%Y %H:%M:%S.%f %z"}
    assert imported(cells, "replace=true", **form).card.digest == digest
    numbers = {n: np.array(v, float) for n, v in cells.items() if n != "time"}
    pq.write_table(pa.table({**numbers, "time": cells["time"]}), "log.parquet")
    import_log(load_import_settings(["log.parquet", "name=furnace", "replace=true"]))
    assert OfflineDataset.open(Path("logs/furnace")).card.digest == digest


def test_the_unused_action_of_the_last_row_may_be_missing(project: Path) -> None:
    cells = furnace()
    for row in range(1 + ROWS, 2 + EPISODES * ROWS, ROWS):
        put("gas", row, "")(cells)
        put("profit", row - ROWS + 1, "")(cells)  # the reward before the first action
    assert imported(cells).transitions == EPISODES * (ROWS - 1)


def gym_cells() -> Cells:
    """As Gymnasium logs: reward and end in the row of their action, no state after the last."""
    cells = furnace()
    cells["tripped"] = ["0"] * len(cells["run"])
    for row in (ROWS - 1, 3 * ROWS - 1):
        cells["tripped"][row] = "1"
    return cells


def test_an_end_without_its_state_is_dropped_or_marked(project: Path) -> None:
    cells = gym_cells()
    log = imported(cells, outcome_row="same", terminal="tripped")
    assert log.transitions == EPISODES * (ROWS - 1)
    assert not log.terminated.any()
    np.testing.assert_array_equal(
        log.rewards.reshape(EPISODES, -1), column(cells, "profit")[:, :-1]
    )
    report = Path("logs/furnace/report.md").read_text(encoding="utf-8")
    assert "- 6 episodes end without the state after their last action; that step is" in report
    assert "2 of them terminal" in report
    marked = {"outcome_row": "same", "terminal": "tripped", "unrecorded_end": "repeat"}
    log = imported(cells, "replace=true", **marked)
    assert log.transitions == EPISODES * (ROWS - 1) + 2
    assert np.flatnonzero(log.terminated).tolist() == [ROWS - 1, 3 * ROWS - 2]
    np.testing.assert_array_equal(log.frames[ROWS], log.frames[ROWS - 1])
    assert log.rewards[ROWS - 1] == column(cells, "profit")[0, -1]


def test_a_terminal_flag_beside_the_terminal_state(project: Path) -> None:
    log = imported(gym_cells(), terminal="tripped")
    assert np.flatnonzero(log.terminated).tolist() == [ROWS - 2, 3 * (ROWS - 1) - 1]
    assert (log.truncated == ~log.terminated)[log.episode_starts[1:] - 1].all()


def test_a_long_log_without_episodes_is_cut(project: Path) -> None:
    cells = furnace(1, 181)
    log = imported(cells, episode=None, episode_rows=60)
    # 181 rows: the one left over stays with the last part
    assert np.diff(log.episode_starts).tolist() == [59, 59, 60]
    for values in cells.values():
        del values[50:55]
    log = imported(cells, "gaps=split", "replace=true", episode=None)
    assert np.diff(log.episode_starts).tolist() == [49, 125]


def test_every_file_is_an_episode_where_no_column_says_so(project: Path) -> None:
    Path("runs").mkdir()
    for n in range(3):
        cells = {name: values[n * ROWS : (n + 1) * ROWS] for name, values in furnace().items()}
        Path("runs", f"{n}.csv").write_text(as_csv(cells), encoding="utf-8")
    write_schema(project, episode=None)
    import_log(load_import_settings(["runs", "name=furnace"]))
    assert OfflineDataset.open(Path("logs/furnace")).episodes == 3


def test_a_linear_reward_over_features_needs_no_column(project: Path) -> None:
    weights = {"temperature": -0.5, "oxygen": 2.0}
    log = imported(furnace(), reward=None, outcome_row=None, reward_weights=weights)
    frames = log.frames.reshape(EPISODES, ROWS, 2)[:, 1:].reshape(-1, 2)
    # the sum is formed in double precision, of numbers about 400
    np.testing.assert_allclose(log.rewards, frames @ [-0.5, 2.0], atol=1e-4)
    cells = gym_cells()
    for row in (ROWS - 1, 3 * ROWS - 1):  # the end in the row of its action, the state after it
        cells["tripped"][row - 1 : row + 1] = ["1", "0"]
    changes = {"reward": None, "reward_weights": weights, "terminal": "tripped"}
    ended = imported(cells, "replace=true", outcome_row="same", **changes)
    np.testing.assert_array_equal(ended.rewards, log.rewards)
    assert ended.terminated.sum() == 2
    dynamics = DynamicsSpecification.of_card(log.card)
    assert (dynamics.learned, dynamics.reward) == (("temperature", "oxygen"), (-0.5, 2.0))


def test_features_that_follow_an_action_are_known(project: Path) -> None:
    cells = furnace()
    moves = np.round(np.random.default_rng(1).uniform(-5, 5, (EPISODES, ROWS)), 3)
    valve = np.full_like(moves, 50.0)
    for t in range(ROWS - 1):
        valve[:, t + 1] = np.clip(valve[:, t] + 2 * moves[:, t], 40, 60)
    cells["move"] = [f"{x:.3f}" for x in moves.ravel()]
    cells["valve"] = [f"{x:.3f}" for x in valve.ravel()]
    log = imported(
        cells,
        features=["temperature", "valve"],
        actions={"move": [-5, 5]},
        known={"bounds": [40, 60], "features": {"valve": {"action": "move", "gain": 2}}},
    )
    assert log.card.frame_features == ("valve", "temperature")
    assert log.card.action_features == ("valve",)
    dynamics = DynamicsSpecification.of_card(log.card)
    assert (dynamics.keep, dynamics.scale, dynamics.low, dynamics.high) == ((1,), (10,), 40, 60)
    rows = log.frame_rows()
    moved = np.clip(log.frames[rows, 0] + 10 * log.actions[:, 0], 40, 60)
    np.testing.assert_allclose(log.frames[rows + 1, 0], moved, atol=2e-3)  # three digits logged


def test_an_earlier_import_is_replaced_only_on_demand(project: Path) -> None:
    before = imported(furnace()).card.digest
    with pytest.raises(SettingsError, match=r"^logs/furnace is there already; give replace=true"):
        imported(furnace(7))
    named = project / "conf" / "dataset" / "furnace.yaml"
    own = "furnace:\n  log: logs/furnace\n  algorithm: {td3_bc: {discount: 0.9}}\n"
    named.write_text(own, encoding="utf-8")
    assert imported(furnace(7), "replace=true").card.digest != before
    assert named.read_text(encoding="utf-8") == own
    cells = furnace()
    put("gas", 9, "")(cells)
    with pytest.raises(SettingsError):
        imported(cells, "replace=true")
    assert OfflineDataset.open(Path("logs/furnace")).episodes == 7
    assert [path.name for path in (project / "logs").iterdir()] == ["furnace"]


def test_an_import_that_is_interrupted_at_the_end_leaves_nothing_and_the_earlier_one(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(dataset: OfflineDataset) -> Figure:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(door, "report_figure", interrupted)
        with pytest.raises(KeyboardInterrupt):
            imported(furnace())
        assert not list((project / "logs").iterdir())
        assert not list((project / "conf" / "dataset").iterdir())
    before = imported(furnace()).card
    with monkeypatch.context() as patched:
        patched.setattr(door, "report_figure", interrupted)
        with pytest.raises(KeyboardInterrupt):
            imported(furnace(7), "replace=true")
    assert [path.name for path in (project / "logs").iterdir()] == ["furnace"]
    assert OfflineDataset.open(Path("logs/furnace")).card == before


def test_cards_of_other_datasets_are_as_they_were() -> None:
    card = make_log().card
    assert not {"action_bounds", "sampling"} & json.loads(card.to_json()).keys()
    wrong = replace(make_log(), card=replace(card, action_bounds=((1.0, 0.0),)))
    with pytest.raises(ValueError, match=r"action_bounds on the card are \(\(1\.0, 0\.0\),\)"):
        wrong.check("the log")


@pytest.mark.slow(2)
def test_a_sweep_learns_from_an_imported_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(composition.CONF, tmp_path / "conf")
    for module in (composition, files, schema):
        monkeypatch.setattr(module, "CONF", tmp_path / "conf")
    monkeypatch.setattr(door, "report_figure", lambda dataset: Figure((1, 1)))
    monkeypatch.chdir(tmp_path)
    composition.base_layers.cache_clear()
    try:
        imported(furnace(8, 90))
        words = ("profile=smoke", "datasets=[furnace]", "seeds=[0]")
        assert benchmark_plan(load_settings((*words, "algorithms=[lion]"))).counts()
        plan = benchmark_plan(load_settings((*words, "algorithms=[bc]")))
        store = finished(plan, tmp_path / "store")
    finally:
        composition.base_layers.cache_clear()
    assert "evaluation" not in plan.counts()
    assert all(store.complete(node.key) for node in plan)
    [data] = [node for node in plan if node.component == "data_generation"]
    stored = OfflineDataset.open(store.path(data.key) / "dataset")
    assert stored.card.action_bounds == ((0.0, 100.0), (0.0, 50.0))


@pytest.mark.parametrize("fields", ["logs: logs/furnace", "discount: 0.97", "{}"])
def test_a_dataset_file_without_a_source_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fields: str
) -> None:
    shutil.copytree(composition.CONF, tmp_path / "conf")
    for module in (composition, files, schema):
        monkeypatch.setattr(module, "CONF", tmp_path / "conf")
    (tmp_path / "conf" / "dataset" / "furnace.yaml").write_text(f"furnace:\n  {fields}\n")
    composition.base_layers.cache_clear()
    try:
        with pytest.raises(SettingsError, match=r"^dataset\.furnace names no source: give `log`"):
            load_settings(("profile=smoke", "datasets=[furnace]"))
    finally:
        composition.base_layers.cache_clear()
