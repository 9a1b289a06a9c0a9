"""The card of a dataset: what it is, where it came from, and how well its controller did."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final

from components.core.cards import CardFormat
from components.core.version import code_version

__all__ = ["REMEDY", "DatasetCard"]

FORMAT_VERSION: Final = 1
REMEDY: Final = "generate the dataset again"
"""What to do about a card, or a file beside it, that cannot be used."""
_DYNAMICS: Final = "machine"
"""Name of the dynamics specification on a stored card."""
_OF_PLANTS: Final = ("action_bounds", "sampling")
"""Fields of imported logs alone."""


@dataclass(frozen=True)
class DatasetCard:
    """What a dataset is, where it came from, and how well its controller did.

    Attributes:
        name: of the dataset, e.g. "mediocre-0.2".
        environment: Gymnasium id of the system it was logged on.
        environment_parameters: its parameters, e.g. {"setpoint": 70.0}.
        controller: name of the controller that logged it.
        controller_digest: of its weights, where it is a trained policy; empty for a formula.
        epsilon: probability per step that the whole action vector is random.
        noise: deviation of the Gaussian noise on the controller's own actions, before clipping.
        seed: of the generation; the random stream depends on name and seed alone.
        trajectories: number of episodes.
        steps: transitions of the longest episode.
        transitions: of all episodes together.
        discount: per step, of all returns below.
        history: frames in an observation, newest first.
        frame_features: names of the values of a frame.
        action_features: names of the values of an action, each in [-1, 1].
        dynamics: the dynamics specification, see `dynamics.py`: `known` (`features`, whose last
            ones follow the actions, with their `keep`, `scale`, `low` and `high`), `learned`
            (features to be predicted) and `reward` (weights of these); optionally `healthy`
            (ranges of frame features outside of which the system has fallen).
        simulator: name and version of the physics engine; empty where it is this package.
        return_steps: window length of all returns below; after a terminal state rewards are 0.
        first_window_return_mean: mean over episodes of the return of the first window, the
            performance of the logging controller under the benchmark's protocol.
        first_window_return_min: the least of them.
        first_window_return_max: the greatest of them.
        all_windows_return_mean: mean over every window start of every episode; windows do not
            cross episodes.
        digest: sha256 over all arrays.
        action_bounds: smallest and largest value of each action in the units of its plant, which
            are -1 and 1 here; empty where the log was not scaled.
        sampling: interval of the frames of a plant; 0 where it is not known.
        code_version: version of the package that made it.
        format_version: of the folder.
    """

    name: str
    environment: str
    environment_parameters: Mapping[str, Any]
    controller: str
    epsilon: float
    seed: int
    trajectories: int
    steps: int
    transitions: int
    discount: float
    history: int
    frame_features: tuple[str, ...]
    action_features: tuple[str, ...]
    dynamics: Mapping[str, Any]
    return_steps: int
    first_window_return_mean: float
    first_window_return_min: float
    first_window_return_max: float
    all_windows_return_mean: float
    digest: str
    controller_digest: str = ""
    noise: float = 0.0
    simulator: str = ""
    action_bounds: tuple[tuple[float, float], ...] = ()
    sampling: float = 0.0
    code_version: str = field(default_factory=code_version)
    format_version: int = FORMAT_VERSION

    def to_json(self) -> str:
        """The card as indented JSON, the same text for the same card."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values[_DYNAMICS] = values.pop("dynamics")
        for name in ("environment_parameters", _DYNAMICS):
            values[name] = dict(values[name])
        for name in _OF_PLANTS:  # cards without them stay as they were
            if not values[name]:
                del values[name]
        return json.dumps(values, indent=2, sort_keys=True, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str, source: object = "a dataset card") -> "DatasetCard":
        """Read a card from the text that :meth:`to_json` made.

        Args:
            text: JSON.
            source: Where it was, for messages.

        Raises:
            ValueError: It is not JSON, fields are missing or unknown, or it has a format that this
                code cannot read.
        """
        return _CARDS.parse(text, source)

    @classmethod
    def load(cls, path: Path) -> "DatasetCard":
        """Read `card.json`.

        Raises:
            FileNotFoundError: There is none.
            ValueError: As :meth:`from_json`.
        """
        return _CARDS.read(path)


def _amend(values: dict[str, Any]) -> None:
    if {"trajectories", "steps"} <= values.keys():  # older cards: all episodes of equal length
        values.setdefault("transitions", values["trajectories"] * values["steps"])
    if _DYNAMICS in values:
        values["dynamics"] = values.pop(_DYNAMICS)
    if "action_bounds" in values:
        values["action_bounds"] = tuple((low, high) for low, high in values["action_bounds"])


_CARDS: Final = CardFormat(
    kind=DatasetCard,
    what="dataset",
    remedy=REMEDY,
    version=("format_version", FORMAT_VERSION),
    amend=_amend,
)
