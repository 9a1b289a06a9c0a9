"""Logs that can be used: what is stored, what is said about it, and that it is a dataset."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import minari
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from matplotlib.figure import Figure
from minari.data_collector import EpisodeBuffer

from components.data.dataset import OfflineDataset
from components.data.dynamics import DynamicsSpecification
from components.data.imports.report import report_figure
from components.data.sources.minari_exchange import export_minari
from flows import import_log as door
from flows.configuration import composition, files, schema
from flows.configuration.settings import SettingsError, load_settings
from flows.import_log import import_log, load_import_settings, read_schema
from flows.planning.benchmark import benchmark_plan
from tests.components.synthetic import make_log
from tests.flows.furnace import EPISODES, ROWS, Cells, as_csv, furnace, put, write_schema
from tests.flows.grid import finished


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project folder with an empty conf/dataset, which is the working folder, too."""
    (tmp_path / "conf" / "dataset").mkdir(parents=True)
    monkeypatch.setattr(files, "CONF", tmp_path / "conf")
    monkeypatch.setattr(door, "report_figure", lambda dataset: Figure((1, 1)))  # drawing is slow
    monkeypatch.chdir(tmp_path)
    return tmp_path


def imported(cells: Cells, *words: str, **changes: object) -> OfflineDataset:
    """What an import in the working folder stores."""
    Path("log.csv").write_text(as_csv(cells), encoding="utf-8")
    write_schema(Path.cwd(), **changes)
    assert import_log(load_import_settings(["log.csv", "name=furnace", *words])) == 0
    return OfflineDataset.open(Path("logs/furnace"))


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


def test_what_looks_wrong_is_a_warning_in_the_report_and_on_the_screen(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = furnace(20, 50)
    half = 500
    changed = [f"{float(v) * 1.8 + 32:.3f}" for v in cells["temperature"][half:]]
    cells["temperature"] = cells["temperature"][:half] + changed
    cells["profit"] = [f"{x:.4f}" for x in np.random.default_rng(3).normal(size=1000)]
    cells["air"] = [str(10 * (row % 3)) for row in range(1000)]  # whole numbers, three of them
    cells["gas"] = [f"{float(v) / 100:.5f}" for v in cells["gas"]]  # 0 ... 1, not per cent
    imported(cells, history=60)
    said = capsys.readouterr().out
    for sentence in (
        r"Warning: log\.csv, row \d+: about here feature 'temperature' seems to change its unit",
        r"Warning: No feature explains the reward: a fit .* explains \d% of it",
        r"Warning: Action 'air' takes 3 values only",
        r"Warning: Action 'gas' uses 0\.8% of the range between its bounds",
        r"Warning: 20 of 20 episodes have fewer steps than the history of 60",
    ):
        assert re.search(sentence, said), sentence
    report = Path("logs/furnace/report.md").read_text(encoding="utf-8")
    assert all(line[9:] in report for line in said.splitlines() if line.startswith("Warning: "))
    row = int(re.search(r"row (\d+): about here feature 'temperature'", said)[1])
    assert abs(row - half) <= 25  # a part of this log has so many rows


def test_sensors_that_fail_are_warned_of_and_the_log_is_kept(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = furnace(20, 50)
    cells["pressure"] = [f"{x:.3f}" for x in np.random.default_rng(1).normal(1.1, 0.01, 1000)]
    cells["fahrenheit"] = [f"{float(v) * 1.8 + 32:.2f}" for v in cells["temperature"]]
    cells["pressure"][200:400] = ["1.103"] * 200
    for row in (120, 340, 600):
        put("oxygen", row, "-9999")(cells)
    imported(cells, features=["temperature", "oxygen", "pressure", "fahrenheit"])
    said = capsys.readouterr().out
    for sentence in (
        r"log\.csv, row 202: feature 'pressure'.* stands still at 1\.103 for 200 rows from here",
        r"log\.csv, row 120: feature 'oxygen' is -9999 in 3 rows, first here, .*na_values: \[-9999",
        r"Feature 'fahrenheit' is a copy of feature 'temperature' .* 1\.8 \* temperature \+ 32;",
    ):
        assert re.search(f"Warning: {sentence}", said), said


@pytest.mark.parametrize("stands", ["after", "same"])
def test_a_reward_in_another_row_than_the_schema_says(
    project: Path, capsys: pytest.CaptureFixture[str], stands: str
) -> None:
    cells = furnace(20, 90)
    gas = np.array(cells["gas"], float)
    if stands == "after":
        gas = np.roll(gas, 1)  # the first row of an episode is not used
    cells["profit"] = [
        f"{-abs(float(t) - 800) - g:.3f}" for t, g in zip(cells["temperature"], gas, strict=True)
    ]
    other = {"after": "same", "same": "after"}[stands]
    imported(cells, outcome_row=stands)
    assert "outcome_row" not in capsys.readouterr().out
    imported(cells, "replace=true", outcome_row=other)
    assert re.search(
        rf"Warning: The action of .* should outcome_row be {stands}\?", capsys.readouterr().out
    )


def test_what_a_sweep_will_leave_out_is_said(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imported(furnace(3, 80))
    said = capsys.readouterr().out
    assert "Warning: The log has 3 episodes, but it takes 4 to divide it" in said
    assert (
        "Warning: The longest episode has 79 steps, but models that read histories need 80" in said
    )
    imported(furnace(4, 81), "replace=true")
    assert "Warning" not in capsys.readouterr().out


def test_a_file_in_another_unit_is_named(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cells = furnace(20, 50)
    half = 500
    Path("a.csv").write_text(as_csv({n: v[:half] for n, v in cells.items()}), encoding="utf-8")
    later = {n: v[half:] for n, v in cells.items()}
    later["gas"] = [f"{float(v) / 60:.4f}" for v in later["gas"]]  # per second
    Path("b.csv").write_text(as_csv(later), encoding="utf-8")
    write_schema(project)
    import_log(load_import_settings(["a.csv", "b.csv", "name=furnace"]))
    said = re.search(
        r"Warning: b\.csv, row 2, where this file begins: action 'gas' seems to be in another unit "
        r"than in a\.csv: its median goes from (\S+) to (\S+) and stays",
        capsys.readouterr().out,
    )
    assert said
    assert 40 < float(said[1]) < 60  # in the log's units
    assert 40 < 60 * float(said[2]) < 60


def test_a_log_as_it_should_be_has_no_warnings(project: Path) -> None:
    imported(furnace(20, 90))
    assert "## What looks wrong\n\nNothing." in Path("logs/furnace/report.md").read_text("utf-8")


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


@pytest.mark.parametrize("kind", ["csv", "semicolons", "parquet"])
def test_a_draft_needs_few_corrections_and_is_never_overwritten(project: Path, kind: str) -> None:
    cells = {n: v for n, v in furnace().items() if n not in ("gas", "air")}
    full = furnace()
    cells |= {"action_gas": full["gas"], "action_air": full["air"], "site": ["Basel"] * 180}
    log = Path("log.parquet" if kind == "parquet" else "log.csv")
    if kind == "parquet":
        table = {
            n: v if n == "site" else np.array(v, float) for n, v in cells.items() if n != "time"
        }
        table["time"] = np.array(cells["time"], "datetime64[s]")
        pq.write_table(pa.table(table), log)
    else:
        log.write_text(as_csv(cells, ";" if kind == "semicolons" else ","), encoding="utf-8")
    words = [str(log), "name=furnace"]
    import_log(load_import_settings([*words, "--describe"]))
    draft = Path("furnace.yaml").read_text(encoding="utf-8")
    with pytest.raises(SettingsError, match="is there already and is left alone"):
        import_log(load_import_settings([*words, "describe=true"]))
    with pytest.raises(SettingsError, match="outcome_row='FILL_IN'"):
        import_log(load_import_settings(words))
    assert Path("furnace.yaml").read_text(encoding="utf-8") == draft
    Path("furnace.yaml").write_text("features: [oxygen]\nactions:\n", encoding="utf-8")
    with pytest.raises(SettingsError, match=r"furnace\.yaml: actions names none; write NAME:"):
        import_log(load_import_settings(words))
    Path("furnace.yaml").write_text(draft.replace("FILL_IN", "after"), encoding="utf-8")
    described = read_schema(Path("furnace.yaml"))
    assert described.features == ("temperature", "oxygen")
    assert list(described.actions) == ["action_gas", "action_air"]
    assert (described.reward, described.episode, described.time) == ("profit", "run", "time")
    assert described.sampling == 10
    assert import_log(load_import_settings(words)) == 0


def test_a_draft_of_a_german_file_names_all_that_is_odd_about_it(project: Path) -> None:
    cells = furnace()
    cells["time"] = [f"{t[8:10]}.{t[5:7]}.{t[:4]} {t[11:]}" for t in cells["time"]]
    cells |= {"site": ["Basel"] * 180, "tank": ["1"] * 180, "action_gas": cells.pop("gas")}
    put("oxygen", 17, "Bad Input")(cells)
    text = as_csv(
        {n: [v.replace(".", ",") if n != "time" else v for v in c] for n, c in cells.items()}, ";"
    )
    Path("log.csv").write_text(text, encoding="utf-8")
    words = ["log.csv", "name=furnace"]
    import_log(load_import_settings([*words, "--describe"]))
    draft = Path("furnace.yaml").read_text(encoding="utf-8")
    assert "# Not used:\n#   site: text, e.g. 'Basel'\n#   tank: always 1 in these rows\n" in draft
    Path("furnace.yaml").write_text(draft.replace("FILL_IN", "after"), encoding="utf-8")
    described = read_schema(Path("furnace.yaml"))
    assert described.features == ("temperature", "oxygen", "air")
    assert (described.delimiter, described.decimal) == (";", ",")
    assert described.time_format == "%d.%m.%Y %H:%M:%S"
    assert described.na_values == ("Bad Input",)
    assert described.sampling == 10
    assert import_log(load_import_settings([*words, "missing=forward_fill"])) == 0


@pytest.fixture
def minari_folder(project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(project / "minari"))
    return project / "minari"


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_minari_dataset_of_others_is_imported_with_a_schema(minari_folder: Path) -> None:
    environment = gym.make("Pendulum-v1")
    environment.action_space.seed(0)
    buffers = []
    for episode in range(4):
        buffer = EpisodeBuffer(id=episode, observations=[environment.reset(seed=episode)[0]])
        acted, rewards = [], []
        for _ in range(20):
            acted.append(environment.action_space.sample())
            seen, reward, *_ = environment.step(acted[-1])
            buffer.observations.append(seen)
            rewards.append(float(reward))
        ends = [False] * 19
        buffers.append(
            replace(
                buffer,
                observations=np.stack(buffer.observations),
                actions=np.stack(acted),
                rewards=rewards,
                terminations=[*ends, False],
                truncations=[*ends, True],
            )
        )
    made = minari.create_dataset_from_buffers(
        "other/pendulum-v0", buffers, env=environment.spec, data_format="hdf5"
    )
    words = ["minari:other/pendulum-v0", "name=furnace"]
    import_log(load_import_settings([*words, "--describe"]))
    described = read_schema(Path("furnace.yaml"))
    assert dict(described.actions) == {"action_0": (-2.0, 2.0)}
    assert described.same_row
    import_log(load_import_settings(words))
    log = OfflineDataset.open(Path("logs/furnace"))
    assert (log.episodes, log.transitions) == (4, 80)
    for n, episode in enumerate(made.iterate_episodes()):
        rows = slice(21 * n, 21 * (n + 1))
        np.testing.assert_array_equal(log.frames[rows], episode.observations.astype(np.float32))
        steps = slice(20 * n, 20 * (n + 1))
        np.testing.assert_array_equal(log.rewards[steps], episode.rewards.astype(np.float32))
        np.testing.assert_allclose(2 * log.actions[steps], episode.actions, atol=1e-6)
    assert log.card.action_bounds == ((-2.0, 2.0),)


def test_our_own_export_comes_back_exactly_and_needs_no_schema(minari_folder: Path) -> None:
    log = make_log()
    exported = export_minari(log, minari_folder)
    import_log(load_import_settings([f"minari:{exported}", "name=mine"]))
    back = OfflineDataset.open(Path("logs/mine"))
    assert back.card == log.card
    for name, array in log.arrays().items():
        np.testing.assert_array_equal(getattr(back, name), array)


def test_an_imported_dataset_comes_back_from_minari_with_its_bounds(minari_folder: Path) -> None:
    log = imported(furnace())
    exported = export_minari(log, minari_folder)
    import_log(load_import_settings([f"minari:{exported}", "name=again"]))
    assert OfflineDataset.open(Path("logs/again")).card == log.card


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
