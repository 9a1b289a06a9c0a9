"""Logs that cannot be: every way to make or read one refuses them in one sentence."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from components.data.assembly import assemble
from components.data.dataset import OfflineDataset, array_digest
from components.data.sources.minari_exchange import export_minari, import_minari
from components.data.sources.stored_log import StoredLog
from tests.components.synthetic import make_log, relabelled

LOG = make_log("plant", episodes=6, steps=80)
Arrays = dict[str, Any]


def put(name: str, place: Any, value: Any) -> Callable[[Arrays], None]:
    return lambda arrays: arrays[name].__setitem__(place, value)


def scaled(factor: float) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.update(actions=arrays["actions"] * np.float32(factor))


def shape(name: str, change: Callable[[Any], Any]) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.update({name: change(arrays[name])})


FAULTS: dict[str, tuple[Callable[[Arrays], None], str]] = {
    "a missing sensor value": (
        put("frames", (100, 4), np.nan),
        "frames hold nan in row 100 of 'fatigue'; a log has no missing or infinite values, so "
        "repair them or leave their episodes out.",
    ),
    "several infinite ones": (
        put("frames", (slice(7, 9), 5), np.inf),
        "frames hold inf in row 7 of 'consumption' (2 such values); a log has",
    ),
    "a missing reward": (put("rewards", 100, np.nan), "rewards hold nan in row 100; a log"),
    "an action not logged": (
        put("actions", 100, np.nan),
        "actions hold nan in row 100 of 'velocity' (3 such values); a log",
    ),
    "actions in per cent": (scaled(100.0), "in [-1, 1], so scale them (are they in per cent?)."),
    "rounded actions": (
        put("actions", (5, 1), np.float32(1.0000001)),
        "actions hold 1.0000001 in row 5 of 'gain', the largest 1.0000001; actions "
        "lie in [-1, 1], so clip what is rounding.",
    ),
    "episode starts in reverse": (
        shape("episode_starts", lambda starts: starts[::-1].copy()),
        "episode_starts must increase from 0 to the number of transitions, 480, but entry 1 is 400",
    ),
    "an empty episode": (
        put("episode_starts", 2, 80),
        "entry 2 is 80; give the first transition of each episode, and that number.",
    ),
    "episodes that start late": (put("episode_starts", 0, 3), "but they go from 3 to 480; give"),
    "episodes that end early": (put("episode_starts", 6, 479), "but they go from 0 to 479; give"),
    "no episode": (shape("episode_starts", lambda starts: starts[:0]), "but they are not; give"),
    "a fall in the middle": (
        put("terminated", 100, True),
        "terminated is set in row 100, which is not the last of its episode (1 such rows); let a "
        "new episode start after it.",
    ),
    "a cut in the middle": (put("truncated", 3, True), "truncated is set in row 3, which is not"),
    "an end without a reason": (
        put("truncated", 159, False),
        "episode 1 ends in row 159 neither terminated nor truncated (1 such episodes); set",
    ),
    "a frame too few": (
        shape("frames", lambda frames: frames[:-6]),
        "frames has 480 rows, but 480 transitions of 6 episodes need 486; an episode has one frame",
    ),
    "a column too many": (
        shape("actions", lambda actions: np.repeat(actions, 2, axis=1)),
        "actions have 6 columns for the 3 features velocity, gain, shift; name each column.",
    ),
    "another type": (
        shape("rewards", lambda rewards: rewards.astype(np.float64)),
        "rewards is float64 with 1 axes; give float32 with 1.",
    ),
}
CARDS: dict[str, tuple[dict[str, Any], str]] = {
    "discount": ({"discount": 1.5}, "the discount on the card is 1.5; it must be above 0 and at"),
    "undefined discount": ({"discount": float("nan")}, "the discount on the card is nan; it must"),
    "history": ({"history": 0}, "history is 0 on the card; at least 1."),
    "returns": (
        {"all_windows_return_mean": float("inf")},
        "all_windows_return_mean is inf on the card; the rewards are too large or undefined",
    ),
    "names": (
        {"action_features": ("gain", "gain", "shift")},
        "the names of action features are gain, gain, shift; give each feature a name of its own.",
    ),
    "dynamics": (
        {"dynamics": {"learned": ["fatigue", "heat"], "healthy": {"torso": [0, 1]}}},
        "the dynamics specification on the card names heat, torso, which the log does not have",
    ),
    "steps": ({"steps": 81}, "the card says steps=81, but the arrays have 80; correct the card."),
}


def harmed(change: Callable[[Arrays], None]) -> OfflineDataset:
    arrays = {name: array.copy() for name, array in LOG.arrays().items()}
    change(arrays)
    return relabelled(LOG, **arrays)


def told(**changes: Any) -> OfflineDataset:
    return dataclasses.replace(LOG, card=dataclasses.replace(LOG.card, **changes))


def store_unchecked(log: OfflineDataset, folder: Path) -> Path:
    """A folder as an earlier version wrote it: whole, with a digest that fits."""
    folder.mkdir()
    for name, array in log.arrays().items():
        np.save(folder / f"{name}.npy", array)
    card = dataclasses.asdict(log.card)
    card["machine"] = card.pop("dynamics")
    (folder / "card.json").write_text(json.dumps(card))
    return folder


@pytest.mark.parametrize("fault", FAULTS)
def test_arrays_that_are_no_log_are_refused(fault: str, tmp_path: Path) -> None:
    change, message = FAULTS[fault]
    log = harmed(change)
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the whole message is compared
        log.write(tmp_path / "log")
    assert str(refused.value).startswith("the log plant: ")
    assert message in str(refused.value)
    assert list(tmp_path.iterdir()) == []
    kept = ("name", "environment", "environment_parameters", "controller", "epsilon", "seed")
    fields = {name: getattr(LOG.card, name) for name in (*kept, "discount", "history", "dynamics")}
    features = {n: getattr(LOG.card, n) for n in ("frame_features", "action_features")}
    with pytest.raises(ValueError) as refused:  # noqa: PT011
        assemble(log.arrays(), **fields, **features)
    assert message in str(refused.value)


@pytest.mark.parametrize("fault", [f for f in FAULTS if f.split()[-1] not in ("few", "type")])
def test_a_stored_log_is_refused_although_its_digest_fits(fault: str, tmp_path: Path) -> None:
    log = harmed(FAULTS[fault][0])
    assert log.card.digest == array_digest(log.arrays())
    folder = store_unchecked(log, tmp_path / "log")
    with pytest.raises(ValueError, match=r"log"):
        OfflineDataset.open(folder)
    with pytest.raises(ValueError, match=r"or correct `log` in conf/dataset/mine\.yaml\.$"):
        StoredLog("mine", str(folder)).generate(0)


@pytest.mark.parametrize("field", CARDS)
def test_cards_that_fit_no_log_are_refused(field: str, tmp_path: Path) -> None:
    changes, message = CARDS[field]
    log = told(**changes)
    with pytest.raises(ValueError) as refused:  # noqa: PT011
        log.write(tmp_path / "log")
    assert message in str(refused.value)
    folder = store_unchecked(log, tmp_path / "stored")
    for check in (True, False) if field != "steps" else (True,):
        with pytest.raises(ValueError) as refused:  # noqa: PT011
            OfflineDataset.open(folder, check=check)
        assert message in str(refused.value)


def test_an_exported_log_is_refused_on_its_way_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = harmed(FAULTS["a missing reward"][0])
    with monkeypatch.context() as unchecked:
        unchecked.setattr(OfflineDataset, "check", lambda log, source: None)
        name = export_minari(log, tmp_path)
    with pytest.raises(ValueError, match=r"^proximity/plant-v0: rewards hold nan in row 100;"):
        import_minari(name, tmp_path)


def test_missing_and_unknown_arrays_are_named() -> None:
    arrays = LOG.arrays()
    del arrays["terminated"], arrays["truncated"]
    with pytest.raises(ValueError, match=r"^the log lacks terminated, truncated; the arrays of a"):
        assemble(arrays, discount=0.9, frame_features=(), action_features=())
    arrays = LOG.arrays() | {"costs": LOG.rewards}
    with pytest.raises(ValueError, match=r"^the log x has the unknown costs; the arrays of a log"):
        assemble(arrays, discount=0.9, frame_features=(), action_features=(), name="x")


def test_a_good_log_is_read_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("components.data.validity._BLOCK", 7)
    LOG.write(tmp_path / "log")
    OfflineDataset.open(tmp_path / "log")
    with pytest.raises(ValueError, match=r"frames hold nan in row 100 of 'fatigue'"):
        harmed(FAULTS["a missing sensor value"][0]).write(tmp_path / "other")
    with pytest.raises(ValueError, match=r"actions hold 1.0000001 in row 5 of 'gain'"):
        harmed(FAULTS["rounded actions"][0]).write(tmp_path / "other")


def test_a_history_may_be_longer_than_every_episode(tmp_path: Path) -> None:
    told(history=200).write(tmp_path / "log")  # the first frame stands in for those before it
