"""Recordings of sessions: a table that is a log like any other, and that replays to the byte.

A recording is a CSV table with a row a step, the schema with which `flows.import_log` reads it, and
a card that says what was operated. Numbers are written so that reading them gives the same ones.
One over recorded states has no schema: states and rewards are the log's, not what the proposed
actions would have led to, and who learned from the two together would learn what is not so.
"""

import csv
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from components.core.cards import CardFormat
from components.core.files import replacing, write_text
from components.core.integrity import DamagedFileError
from components.environments.systems import SYSTEMS
from components.operating.operable import Operable
from components.operating.session import DRIVERS, Session, Step

__all__ = ["Recording", "RecordingCard", "card_of", "replay"]

_TABLE: Final = "session.csv"
_SCHEMA: Final = "session.yaml"
_CARD: Final = "session.json"
_ACTION: Final = "action "
_PROPOSED: Final = "proposed "  # an action that had no effect
_OF_LOG: Final = "log "  # before a name of the log that is also one of the table's own
_WRITTEN: Final = ("episode", "step", "driver", "lambda", "demanded")
_RESULTS: Final = ("reward", "terminal", "distance", "strangeness", "behaviour reward")


@dataclass(frozen=True, kw_only=True)
class RecordingCard:
    """What a recording is of.

    Attributes:
        policy: Id under which the policy was chosen.
        weights: Digest of what acted, see :attr:`.operable.Operable.digest`.
        seed: Of the session.
    """

    policy: str
    weights: str
    seed: int


_CARDS: Final = CardFormat(
    kind=RecordingCard, what="recording", remedy="give a folder that the console has saved"
)


class Recording:
    """The steps of a session, as a table.

    Args:
        operable: What is operated.
        policy: Id under which it was chosen.
        seed: Of the session.
    """

    def __init__(self, operable: Operable, policy: str, seed: int) -> None:
        self._card = RecordingCard(policy=policy, weights=operable.digest, seed=seed)
        card = operable.card
        self._real = card.environment in SYSTEMS
        acted = _ACTION if self._real else _PROPOSED
        named = [*card.frame_features, *(acted + name for name in card.action_features)]
        columns = _apart(named, (*_WRITTEN, *_RESULTS))
        count = len(card.frame_features)
        self._log, self._frames, self._actions = card, columns[:count], columns[count:]
        self._bounds = card.action_bounds or ((-1.0, 1.0),) * len(self._actions)
        names = [*_WRITTEN, *columns, *_RESULTS]
        self._first: list[float] = []
        self._changed = [False] * len(columns)
        self._text = io.StringIO()
        self._table = csv.writer(self._text, lineterminator="\n")
        self._table.writerow(names)
        self.steps = 0

    def add(self, step: Step, driver: str = "") -> None:
        """Write a step down.

        Args:
            step: The step.
            driver: Whom to name as its driver; by default who it was.
        """
        frame, action = step.frames[0], step.actions[0]
        scaled = [
            low + (value + 1) / 2 * (high - low)
            for value, (low, high) in zip(action.tolist(), self._bounds, strict=True)
        ]
        written = (step.episode, step.step, driver or step.driver, step.proximity, step.setpoint)
        rewards = step.rewards.tolist()
        results = (rewards[0], int(step.ended), step.distance, step.strangeness, rewards[1])
        values = [*frame.tolist(), *scaled]
        self._first = self._first or values
        self._changed = [
            changed or value != first
            for changed, value, first in zip(self._changed, values, self._first, strict=True)
        ]
        self._table.writerow([*written, *values, *results])
        self.steps += 1

    @property
    def table(self) -> str:
        """The text of the CSV file."""
        return self._text.getvalue()

    @property
    def is_log(self) -> bool:
        """Whether something can be learned from it: actions had an effect on a system."""
        return self._real

    @property
    def schema(self) -> str:
        """The text of the schema with which `flows.import_log` reads the table.

        It leaves out what never changed, e.g. a setpoint that nobody touched: an import refuses
        such columns, as nothing can be learned from them.
        """
        card, count = self._log, len(self._frames)
        bounds = zip(self._actions, self._bounds, strict=True)
        actions = {name: [low, high] for name, (low, high) in bounds}
        moved = _kept(self._actions, self._changed[count:])
        values = {
            "features": _kept(self._frames, self._changed[:count]),
            "actions": {name: actions[name] for name in moved},
            "reward": "reward",
            "outcome_row": "same",
            "terminal": "terminal",
            "unrecorded_end": "repeat",
            "episode": "episode",
            "history": card.history,
            "discount": card.discount,
            "controller": "a session of the console",
        }
        return json.dumps(values, indent=2, allow_nan=False) + "\n"  # JSON is YAML, too

    def save(self, folder: Path) -> None:
        """Write the files into a new folder, which appears complete or not at all."""
        folder.parent.mkdir(parents=True, exist_ok=True)
        with replacing(folder) as made:
            made.mkdir()
            write_text(made / _TABLE, self.table)
            if self._real:
                write_text(made / _SCHEMA, self.schema)
            write_text(made / _CARD, json.dumps(asdict(self._card), indent=2) + "\n")


@dataclass(frozen=True)
class _Row:
    """What was decided in a recorded step."""

    episode: int
    driver: str
    proximity: float
    setpoint: float


def card_of(folder: Path) -> RecordingCard:
    """What a saved recording is of.

    Raises:
        MissingFileError: The folder holds none.
        DamagedFileError: It is damaged.
    """
    return _CARDS.read(folder / _CARD)


def replay(folder: Path, operable: Operable) -> int:
    """Decide again as a recording says, and compare the whole table.

    Args:
        folder: That :meth:`Recording.save` has written.
        operable: What was operated.

    Returns:
        The number of steps.

    Raises:
        DamagedFileError: The recording is damaged, or is not of this policy.
        ValueError: The table is another one; names the first row that differs.
    """
    card = card_of(folder)
    if card.weights != operable.digest:
        raise DamagedFileError(
            f"{folder} was recorded with other weights of {card.policy}; it cannot be replayed",
            folder,
        )
    path = folder / _TABLE
    recorded = path.read_text(encoding="utf-8")
    session, again = Session(operable, card.seed), Recording(operable, card.policy, card.seed)
    for row in _rows(recorded, path):
        if row.episode > session.episode and not session.over:
            session.restart()
        if session.plant.setpoint not in (None, row.setpoint):
            session.plant.demand(row.setpoint)
        session.proximity = row.proximity
        # What a pilot chose is in the row, so that the policy at that proximity repeats it.
        session.driver = "behaviour" if row.driver == "behaviour" else "operator"
        again.add(session.step(), row.driver)
    _compare(recorded.splitlines(), again.table.splitlines(), path)
    return again.steps


def _apart(names: Sequence[str], taken: Sequence[str]) -> list[str]:
    """Names that differ from each other and from those that are taken."""
    apart: list[str] = []
    for name in names:
        while name in taken or name in apart:
            name = _OF_LOG + name
        apart.append(name)
    return apart


def _kept(names: list[str], changed: list[bool]) -> list[str]:
    """Names of columns that changed; all where none did, so that the import says what it misses."""
    return [name for name, moved in zip(names, changed, strict=True) if moved] or names


def _rows(text: str, path: Path) -> Iterator[_Row]:
    for number, line in enumerate(csv.DictReader(io.StringIO(text)), start=2):
        try:
            row = _Row(
                int(line["episode"]),
                line["driver"],
                float(line["lambda"]),
                float(line["demanded"]),
            )
            if row.driver not in DRIVERS or not 0 <= row.proximity <= 1:
                raise ValueError
        except (KeyError, TypeError, ValueError) as error:
            raise DamagedFileError(f"{path} is damaged in line {number}", path) from error
        yield row


def _compare(recorded: Sequence[str], again: Sequence[str], path: Path) -> None:
    if recorded == again:
        return
    pairs = enumerate(zip(recorded, again, strict=False), start=1)
    first = next((n for n, (old, new) in pairs if old != new), min(len(recorded), len(again)) + 1)
    raise ValueError(f"{path} does not replay: line {first} is another one.")
