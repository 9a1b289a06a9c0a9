"""Drafts of schemas by --describe: what they guess, what they name, what is left to correct."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flows.configuration.settings import SettingsError
from flows.import_log import import_log, load_import_settings, read_schema
from tests.flows.furnace import as_csv, furnace, put


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
