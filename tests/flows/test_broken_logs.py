"""Logs that cannot be used: one sentence with file, row and column, and nothing is stored."""

import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from flows.command_line import run_door
from flows.configuration.settings import SettingsError
from flows.import_log import HELP, import_log, load_import_settings
from tests.flows.furnace import Cells, as_csv, furnace, put, write_schema


def refused(project: Path, *words: str) -> str:
    """The sentence that refuses an import; nothing may have been stored."""
    before = sorted(project.rglob("*"))
    with pytest.raises(SettingsError) as caught:
        import_log(load_import_settings([*words, "name=furnace"]))
    assert sorted(project.rglob("*")) == before, "something was left behind"
    sentence = str(caught.value)
    assert "\n" not in sentence
    return sentence


def repeat_row(row: int) -> Callable[[Cells], None]:
    def spoil(cells: Cells) -> None:
        for values in cells.values():
            values.insert(row - 2, values[row - 2])

    return spoil


def drop_rows(first: int, last: int) -> Callable[[Cells], None]:
    def spoil(cells: Cells) -> None:
        for values in cells.values():
            del values[first - 2 : last - 1]

    return spoil


def copy(column: str, new: str) -> Callable[[Cells], None]:
    def spoil(cells: Cells) -> None:
        cells[column] = list(cells[new])

    return spoil


def constant(column: str, value: str) -> Callable[[Cells], None]:
    def spoil(cells: Cells) -> None:
        cells[column] = [value] * len(cells[column])

    return spoil


CELLS = {
    "missing value": (put("oxygen", 17, ""), r"log\.csv, row 17: 'oxygen' is missing; repair"),
    "several missing": (
        constant("oxygen", "NA"),
        r"row 2: 'oxygen' is missing \(180 missing or infinite values in all\)",
    ),
    "not a number": (put("gas", 40, "NaN"), r"log\.csv, row 40: 'gas' is missing"),
    "infinite": (put("temperature", 9, "inf"), r"log\.csv, row 9: 'temperature' is inf"),
    "infinite action": (put("air", 9, "-inf"), r"log\.csv, row 9: 'air' is missing"),
    "missing reward": (put("profit", 20, ""), r"log\.csv, row 20: 'profit' is missing"),
    "huge": (put("temperature", 7, "1e30"), r"row 7: 'temperature' is 1e\+30, too large"),
    "text in a cell": (
        put("oxygen", 12, "broken"),
        r"row 12: 'oxygen' is 'broken', .* give `na_values: \['broken'\]` in",
    ),
    "column of text": (constant("oxygen", "high"), r"log\.csv, row 2: 'oxygen' is 'high'"),
    "column of flags": (constant("oxygen", "true"), r"row 2: 'oxygen' is 'true'; write 1 and 0"),
    "thousands separators": (
        put("temperature", 30, '"1,234.5"'),
        r"log\.csv, row 30: 'temperature' is '1,234\.5', .* thousands separators",
    ),
    "bare thousands separators": (
        put("temperature", 30, "1,234.5"),
        r"log\.csv, row 30, has 8 columns, not 7 .* thousands separators",
    ),
    "decimal comma": (
        put("temperature", 5, '"812,5"'),
        r"row 5: 'temperature' is '812,5'; .* `decimal: ','` in the schema",
    ),
    "mixed units": (
        put("temperature", 33, "1490 °F"),
        r"row 33: 'temperature' is '1490 °F', a number with a unit",
    ),
    "underscores": (put("gas", 3, "1_0"), r"row 3: 'gas' is '1_0', which is no number"),
    "flow": (put("gas", 3, "5 m3/h"), r"row 3: 'gas' is '5 m3/h', a number with a unit"),
    "per cent": (put("gas", 3, "55%"), r"row 3: 'gas' is '55%', a number with a unit"),
    "action beyond": (put("gas", 61, "120"), r"row 61: action 'gas' is 120, .* bounds 0 to 100"),
    "action below": (put("air", 2, "-1"), r"log\.csv, row 2: action 'air' is -1, outside"),
    "duplicate in time": (repeat_row(18), r"row 19: time 'time' is that of the row before"),
    "gap in time": (drop_rows(12, 13), r"row 12: time 'time' is 30 after .* sampling of 10; give"),
    "time goes back": (
        put("time", 20, "2026-02-28T23:00:00"),
        r"row 20: time 'time' goes back by .* \(2 such rows\); sort",
    ),
    "wrong interval": (
        put("time", 20, "2026-03-01T00:02:55"),
        r"row 20: time 'time' is only 5 after",
    ),
    "summer time": (
        lambda cells: [
            put("time", r, f"2026-03-01T01:{(r - 2) // 6:02}:{(r - 2) % 6}0")(cells)
            for r in range(12, 32)
        ],
        r"row 12: time 'time' is 3610 after .*change to summer time\? give times in UTC",
    ),
    "mixed time zones": (
        put("time", 25, "2026-03-01T00:03:50+01:00"),
        r"row 25: 'time' is '2026-03-01T00:03:50\+01:00', but '2026-03-01T00:00:00' before it",
    ),
    "no time": (put("time", 6, "noon"), r"log\.csv, row 6: 'time' is 'noon', which is no time"),
    "local dates": (
        constant("time", "31.12.2025 10:00"),
        r"row 2: 'time' is '31\.12\.2025 10:00', .* give `time_format: '%d\.%m\.%Y %H:%M'` in",
    ),
    "text among numbers of time": (
        lambda cells: [
            put("time", r, "x" if r == 9 else str(10 * r))(cells) for r in range(2, 182)
        ],
        r"log\.csv, row 9: 'time' is 'x', which is no number",
    ),
    "missing time": (put("time", 6, ""), r"log\.csv, row 6: time 'time' is missing"),
    "missing episode": (put("run", 6, ""), r"log\.csv, row 6: episode 'run' is missing"),
    "episode in two parts": (
        lambda cells: [put("run", r, "0")(cells) for r in range(62, 92)],
        r"row 62: episode '0' of column 'run' begins again after another one",
    ),
    "single rows": (put("run", 31, "x"), r"row 31: the episode that begins here has a single row"),
    "constant feature": (constant("oxygen", "5"), r"row 2: feature 'oxygen' has one value here"),
    "constant action": (constant("air", "5"), r"row 2: action 'air' has one value here"),
    "duplicated feature": (
        copy("oxygen", "temperature"),
        r"log\.csv, row 2: feature 'temperature' equals feature 'oxygen'",
    ),
    "feature that is an action": (
        copy("oxygen", "gas"),
        r"log\.csv, row 2: feature 'oxygen' equals action 'gas'",
    ),
    "one row": (drop_rows(3, 181), r"log\.csv, row 2: the episode .* has a single row"),
    "one episode": (drop_rows(32, 181), r"^the log has one episode; at least 2 are"),
    "no rows": (drop_rows(2, 181), r"log\.csv has no rows below row 1"),
}


@pytest.mark.parametrize(("spoil", "sentence"), CELLS.values(), ids=CELLS)
def test_spoilt_cells(project: Path, spoil: Callable[[Cells], object], sentence: str) -> None:
    cells = furnace()
    spoil(cells)
    (project / "log.csv").write_text(as_csv(cells), encoding="utf-8")
    write_schema(project)
    assert_says(refused(project, "log.csv"), sentence)


def assert_says(said: str, sentence: str) -> None:
    assert re.search(sentence, said), said


def text_of(change: Callable[[str], str]) -> bytes:
    return change(as_csv(furnace())).encode()


TEXTS: dict[str, tuple[bytes, str]] = {
    "semicolons": (
        as_csv(furnace(), ";").encode(),
        r"log\.csv has the one column .* in row 1; if ';' separates .* `delimiter: ';'`",
    ),
    "latin-1 header": (
        text_of(lambda t: t.replace("oxygen", "säuerstoff", 1)).decode().encode("latin-1"),
        r"log\.csv, row 1, is not utf-8 \(0xe4 in byte \d+\)",
    ),
    "latin-1 cell": (
        as_csv({**furnace(), "run": ["é"] * 180}).encode("latin-1"),
        r"log\.csv, row 2: 'run' holds b'\\xe9', which is not UTF-8",
    ),
    "utf-16": (as_csv(furnace()).encode("utf-16"), r"log\.csv, row 1, is UTF-16"),
    "duplicate names": (
        text_of(lambda t: t.replace("oxygen", "temperature", 1)),
        r"log\.csv has 2 columns of the name 'temperature'",
    ),
    "lacking column": (
        text_of(lambda t: t.replace("oxygen", "oxigen", 1)),
        r"log\.csv has no column 'oxygen'; it has .* did you mean 'oxigen'\?",
    ),
    "lacking cells": (
        text_of(lambda t: t.replace(t.splitlines()[9], "1,2,3")),
        r"log\.csv, row 10, has 3 columns, not 7",
    ),
    "no end of the header": (b"temperature,oxygen", r"log\.csv has no rows below row 1"),
    "empty": (b"", r"log\.csv is empty"),
}


@pytest.mark.parametrize(("content", "sentence"), TEXTS.values(), ids=TEXTS)
def test_spoilt_files(project: Path, content: bytes, sentence: str) -> None:
    (project / "log.csv").write_bytes(content)
    write_schema(project)
    assert_says(refused(project, "log.csv"), sentence)


def test_a_million_rows_with_one_missing_value(project: Path) -> None:
    rows, wrong = 1_000_000, 654_321
    rng = np.random.default_rng(0)
    columns = {
        name: rng.random(rows, np.float32) for name in ("temperature", "oxygen", "gas", "profit")
    }
    columns["oxygen"][wrong - 1] = np.nan
    columns["run"] = np.arange(rows) // 1000
    pq.write_table(pa.table(columns), project / "log.parquet")
    write_schema(project, actions={"gas": [0, 1]}, time=None, sampling=None)
    said = refused(project, "log.parquet")
    assert said.startswith("log.parquet, row 654321: 'oxygen' is missing;")


def parquet(project: Path, **columns: Any) -> str:
    cells = furnace()
    numbers = {n: np.array(v, np.float64) for n, v in cells.items() if n not in ("run", "time")}
    table = {**numbers, "run": cells["run"], "time": np.array(cells["time"], "datetime64[s]")}
    pq.write_table(pa.table({**table, **columns}), project / "log.parquet")
    return "log.parquet"


def test_parquet_columns_of_other_kinds(project: Path) -> None:
    write_schema(project)
    said = refused(project, parquet(project, oxygen=["5"] * 180))
    assert_says(said, r"log\.parquet: column 'oxygen' holds string from row 1 on, not numbers")
    said = refused(project, parquet(project, time=["noon"] * 180))
    assert_says(said, r"log\.parquet: column 'time' holds string from row 1 on, not time")


def test_a_parquet_file_that_is_none(project: Path) -> None:
    (project / "log.parquet").write_bytes(b"PAR1 and nothing else")
    write_schema(project)
    assert_says(refused(project, "log.parquet"), r"log\.parquet cannot be read as Parquet \(")


def test_files_whose_times_do_not_fit_together(project: Path) -> None:
    (project / "a.csv").write_text(as_csv(furnace()), encoding="utf-8")
    cells = furnace()
    cells["run"] = [f"b{run}" for run in cells["run"]]
    cells["time"] = [f"{time}Z" for time in cells["time"]]
    (project / "b.csv").write_text(as_csv(cells), encoding="utf-8")
    write_schema(project)
    said = refused(project, "a.csv", "b.csv")
    assert_says(said, r"b\.csv, row 2: times 'time' are time stamps with .* a\.csv, row 2 time")


def test_times_of_another_format_than_the_schema_says(project: Path) -> None:
    cells = furnace()
    cells["time"] = [f"{t[8:10]}.{t[5:7]}.{t[:4]} {t[11:]}" for t in cells["time"]]
    put("time", 9, "2026-03-01 00:01:10")(cells)
    (project / "log.csv").write_text(as_csv(cells), encoding="utf-8")
    write_schema(project, time_format="%d.%m.%Y %H:%M:%S")
    said = refused(project, "log.csv")
    assert_says(
        said, r"log\.csv, row 9: 'time' is '2026-03-01 00:01:10', .* no time of time_format"
    )
    write_schema(project, time_format="%d.%Q")
    assert_says(refused(project, "log.csv"), r"time_format '%d\.%Q' cannot be read")


def test_files_that_number_their_episodes_anew(project: Path) -> None:
    for name in ("a.csv", "b.csv"):
        (project / name).write_text(as_csv(furnace()), encoding="utf-8")
    write_schema(project)
    said = refused(project, "a.csv", "b.csv")
    assert_says(said, r"^b\.csv, row 2: episode '0' .* in a\.csv, too; .* give gaps=split")


def test_terminal_rows_in_the_middle_and_flags_that_are_none(project: Path) -> None:
    cells = {**furnace(), "tripped": ["0"] * 180}
    cells["tripped"][8] = "1"
    (project / "log.csv").write_text(as_csv(cells), encoding="utf-8")
    write_schema(project, terminal="tripped")
    said = refused(project, "log.csv")
    assert_says(said, r"log\.csv, row 10: terminal 'tripped' is set, but its episode goes on")
    for value, shown in (("maybe", "'tripped' is 'maybe'; a flag"), ("", "'tripped' is missing")):
        cells["tripped"][8] = value
        (project / "log.csv").write_text(as_csv(cells), encoding="utf-8")
        assert_says(refused(project, "log.csv"), rf"log\.csv, row 10: .*{shown}")


def test_known_features_that_do_not_follow(project: Path) -> None:
    (project / "log.csv").write_text(as_csv(furnace()), encoding="utf-8")
    follower = {"oxygen": {"action": "air", "gain": 1}, "temperature": {"action": "gas", "gain": 1}}
    known = {"bounds": [-2000, 2000], "features": follower}
    write_schema(project, features=["temperature", "oxygen"], known=known)
    assert_says(refused(project, "log.csv"), r"known: 'oxygen' .* bounds 0 to 50 are not symmetric")
    write_schema(project, known=known, actions={"gas": [-100, 100], "air": [-50, 50]})
    said = refused(project, "log.csv")
    assert_says(said, r"log\.csv, row 3: 'oxygen' goes from .* 'air' moves it to")


SCHEMAS = {
    "unknown key": ({"featurs": ["a"]}, r"Unknown key 'featurs'; .* Did you mean 'features'\?"),
    "two roles": ({"actions": {"oxygen": [0, 1]}}, r"'oxygen' is named in features and actions"),
    "bounds": ({"actions": {"gas": [100, 0]}}, r"bounds of action 'gas' are 100 and 0"),
    "one bound": ({"actions": {"gas": [100]}}, r"actions\.gas"),
    "two rewards": ({"reward_weights": {"oxygen": 1}}, "has both of reward .* and reward_weights"),
    "no reward": ({"reward": None}, "has neither of reward"),
    "no row": ({"outcome_row": None}, "outcome_row is missing; say whether"),
    "draft": ({"outcome_row": "FILL_IN"}, "outcome_row='FILL_IN': Input should be 'after' or"),
    "weight": ({"reward": None, "reward_weights": {"x": 1}}, "reward_weights names 'x', which"),
    "format alone": ({"time": None, "time_format": "%d"}, "time_format is given without time"),
    "sampling": ({"sampling": None}, "time needs sampling"),
    "history": ({"history": 0}, "history is 0; give at least 1"),
    "discount": ({"discount": 1.5}, r"discount is 1\.5"),
    "no features": ({"features": []}, "features is empty"),
    "text for a number": ({"history": "ten"}, "history='ten'"),
    "misspelt and missing": (
        {"feature": ["a"], "features": None},
        r"Unknown key 'feature'; .*s'\?",
    ),
    "no group": ({"actions": ["gas"]}, r"actions is \['gas'\]; write NAME: \[LEAST, LARGEST\]"),
    "no weights": ({"reward_weights": ["gas"]}, r"reward_weights is .*; write NAME: WEIGHT"),
    "reward as a feature": ({"features": ["reward", "oxygen"]}, "rename the column"),
}


@pytest.mark.parametrize(("changes", "sentence"), SCHEMAS.values(), ids=SCHEMAS)
def test_wrong_schemas(project: Path, changes: dict[str, Any], sentence: str) -> None:
    (project / "log.csv").write_text(as_csv(furnace()), encoding="utf-8")
    write_schema(project, **changes)
    assert_says(refused(project, "log.csv"), rf"^furnace\.yaml: .*{sentence}")


def test_files_that_are_none(project: Path) -> None:
    write_schema(project)
    assert_says(refused(project, "nothing.csv"), r"there is no file nothing\.csv")
    for name, said in (
        ("a.xlsx", "is neither CSV nor Parquet"),
        ("a.hdf5", "is HDF5, .*minari:ID"),
    ):
        (project / name).write_bytes(b"")
        assert_says(refused(project, name), rf"{name} {said}")
    with h5py.File(project / "b.h5", "w") as file:  # never opened, so its link is not followed
        file["observations"] = h5py.ExternalLink("/etc/hostname", "/")
    assert_says(refused(project, "b.h5"), r"b\.h5 is HDF5, which is not read directly")
    (project / "empty").mkdir()
    assert_says(refused(project, "empty"), "empty holds no files")


@pytest.fixture
def root(project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(project / "minari"))
    return project / "minari"


def make_minari(observations: Any, space: Any, actions: Any, acts: Any) -> None:
    buffers = [
        EpisodeBuffer(
            id=n,
            observations=observations,
            actions=actions,
            rewards=list(np.arange(5.0)),
            terminations=[False] * 5,
            truncations=[False] * 4 + [True],
        )
        for n in range(2)
    ]
    minari.create_dataset_from_buffers(
        "other/toy-v0", buffers, observation_space=space, action_space=acts, data_format="hdf5"
    )


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_minari_datasets_that_are_not_flat(root: Path) -> None:
    project, box = root.parent, spaces.Box(-1, 1, (2,), np.float32)
    write_schema(project, features=["observation_0"], actions={"action_0": [-1, 1]})
    flat, images = np.zeros((6, 2), np.float32), np.zeros((6, 4, 4, 3), np.uint8)
    acted = np.zeros((5, 2), np.float32)
    kinds = {
        "observations are of the kind Dict": (
            {"a": flat},
            spaces.Dict({"a": box}),
            acted,
            box,
        ),
        "actions are of the kind Discrete": (flat, box, np.zeros(5, int), spaces.Discrete(3)),
        r"observations are images of the shape \(4, 4, 3\)": (
            images,
            spaces.Box(0, 255, (4, 4, 3), np.uint8),
            acted,
            box,
        ),
    }
    for said, arguments in kinds.items():
        make_minari(*arguments)
        sentence = refused(project, "minari:other/toy-v0")
        assert_says(sentence, rf"^minari:other/toy-v0: {said}; only flat boxes can be imported\.$")
        shutil.rmtree(root)
    for words in ((), ("--describe", "schema=draft.yaml")):
        sentence = refused(project, "minari:other/toy-v0", *words)
        assert_says(sentence, "^minari:other/toy-v0: there is no such dataset below")


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_minari_file_with_an_external_link_is_refused_unread(root: Path) -> None:
    box = spaces.Box(-1, 1, (2,), np.float32)
    make_minari(np.zeros((6, 2), np.float32), box, np.zeros((5, 2), np.float32), box)
    [file] = root.rglob("*.hdf5")
    with h5py.File(file, "r+") as content:
        del content["episode_1/observations"]
        content["episode_1/observations"] = h5py.ExternalLink("/etc/hostname", "/x")
    write_schema(root.parent, features=["observation_0"], actions={"action_0": [-1, 1]})
    said = refused(root.parent, "minari:other/toy-v0")
    assert_says(said, r"'episode_1/observations' in main_data\.hdf5 leads to /etc/hostname")


def test_wrong_command_lines(project: Path) -> None:
    def said(*words: str) -> str:
        with pytest.raises(SettingsError) as caught:
            load_import_settings(words)
        return str(caught.value)

    assert said("name=a") == "no file is given; write e.g. log.csv name=furnace."
    assert said("a.csv") == "name= is missing; write e.g. name=furnace."
    assert_says(said("a.csv", "name=a", "mising=drop_episode"), "Did you mean 'missing'")
    assert_says(said("a.csv", "name=a", "missing=drop"), "missing='drop': Input should be 'refuse'")
    assert_says(
        said("a.csv", "name=../a"), r"^name='\.\./a' cannot .* letters, digits, \. _ and - only"
    )
    assert_says(said("a.csv", "name=Tank A"), r"^name='Tank A' cannot be used")
    assert_says(said("a.csv", "name=a", "name=b"), "name is given twice")


def test_names_and_folders_that_are_taken(project: Path) -> None:
    (project / "log.csv").write_text(as_csv(furnace()), encoding="utf-8")
    write_schema(project)
    named = project / "conf" / "dataset" / "furnace.yaml"
    named.write_text("furnace:\n  controller: bad\n  epsilon: 0.1\n", encoding="utf-8")
    assert_says(refused(project, "log.csv"), r"conf/dataset/furnace\.yaml is there already")
    named.unlink()
    (project / "logs" / "furnace").mkdir(parents=True)
    (project / "logs" / "furnace" / "mine.txt").write_text("mine", encoding="utf-8")
    assert_says(refused(project, "log.csv"), r"logs/furnace is there already; give replace=true")
    assert_says(refused(project, "log.csv", "replace=true"), "holds no dataset to replace")


def test_the_door_exits_with_2(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = furnace()
    put("oxygen", 17, "")(cells)
    (project / "log.csv").write_text(as_csv(cells), encoding="utf-8")
    write_schema(project)
    monkeypatch.setattr(sys, "argv", ["import_log", "log.csv", "name=furnace"])
    with pytest.raises(SystemExit) as caught:
        run_door("import_log", HELP, load_import_settings, import_log)
    assert caught.value.code == 2
    assert capsys.readouterr().err.startswith("import_log: log.csv, row 17: 'oxygen' is missing;")
