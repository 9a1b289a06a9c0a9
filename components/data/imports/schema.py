"""What the columns of a log mean: the schema that its owner writes, and how repairs are chosen."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from components.data.dynamics import REWARD

__all__ = ["Follower", "Known", "LogError", "LogSchema", "Repairs"]


class LogError(ValueError):
    """A log or its schema cannot be used; one sentence with file, row and column."""


@dataclass(frozen=True)
class Follower:
    """A feature that follows exactly from an action.

    Attributes:
        action: Column of the action.
        gain: Change of the feature per unit of the action, both in their own units.
        keep: Factor of the feature's old value: 1 where the action is a change of it.
    """

    action: str
    gain: float
    keep: float = 1.0


@dataclass(frozen=True)
class Known:
    """Features that follow exactly from the actions: ``clip(keep * old + gain * action)``.

    Attributes:
        bounds: Smallest and largest value of all of them.
        features: Each feature's action; every action has one.
    """

    bounds: tuple[float, float]
    features: Mapping[str, Follower]


@dataclass(frozen=True)
class Repairs:
    """What to do about a log that is not whole.

    Attributes:
        missing: About missing and infinite values: refuse the log, drop the episode, or repeat the
            value of the row before.
        gaps: About gaps in time: refuse the log, or let a new episode begin after each.
        short: About episodes without a single whole step: refuse the log, or drop them.
    """

    missing: Literal["refuse", "drop_episode", "forward_fill"] = "refuse"
    gaps: Literal["refuse", "split"] = "refuse"
    short: Literal["refuse", "drop"] = "refuse"


@dataclass(frozen=True)
class LogSchema:
    """What the columns of a log mean.

    Attributes:
        features: Columns of the state, in the log's own units.
        actions: Columns that the controller set, each with its smallest and largest value.
        reward: Column of the reward, or
        reward_weights: weight of each feature in it; the reward is that of the state after the
            action.
        outcome_row: Where reward and end of an action stand: `after`, in the next row, with the
            state that the action led to, as in the log of a plant; or `same`, in the row of the
            action, as in those of Gymnasium. Needed where there is a column of either.
        terminal: Column that is 1 where an episode ended for good; all others were merely cut.
        unrecorded_end: Where `same` leaves a terminal state unrecorded: `drop` the last step, or
            keep it and `repeat` the last recorded state in its place.
        episode: Column whose value changes where an episode begins. Without one, every file is an
            episode, and a new one begins after each terminal row.
        episode_rows: Longer episodes are cut after so many rows.
        time: Column of time: numbers, or time stamps.
        sampling: Interval of the rows, in the unit of `time`; seconds for time stamps.
        time_format: How its texts are written, as `strptime` reads them; None for ISO.
        jitter: Largest deviation from it, as a share of it.
        history: Newest rows that a policy sees.
        discount: Per step, of returns.
        known: Features that follow exactly from the actions, if any.
        controller: Who or what set the actions.
        delimiter: Of CSV files.
        decimal: Decimal point of CSV files.
        encoding: Of CSV files.
        na_values: Texts and numbers that stand for no value.

    Raises:
        LogError: A value that cannot be, or fields that contradict each other.
    """

    features: tuple[str, ...]
    actions: Mapping[str, tuple[float, float]]
    history: int
    discount: float
    reward: str | None = None
    reward_weights: Mapping[str, float] | None = None
    outcome_row: Literal["after", "same"] | None = None
    terminal: str | None = None
    unrecorded_end: Literal["drop", "repeat"] = "drop"
    episode: str | None = None
    episode_rows: int | None = None
    time: str | None = None
    sampling: float | None = None
    time_format: str | None = None
    jitter: float = 0.1
    known: Known | None = None
    controller: str = "unknown"
    delimiter: str = ","
    decimal: str = "."
    encoding: str = "utf-8"
    na_values: tuple[str | float, ...] = ()

    def __post_init__(self) -> None:
        self._check_roles()
        self._check_outcomes()
        self._check_numbers()
        if self.known is not None:
            self._check_known(self.known)

    @property
    def weights(self) -> Mapping[str, float]:
        """Weights of features in the reward; empty where it has a column of its own."""
        return self.reward_weights or {}

    @property
    def same_row(self) -> bool:
        """Whether reward and end stand in the row of their action."""
        return self.outcome_row == "same"

    @property
    def reward_after(self) -> bool:
        """Whether the reward stands in the row after its action: so do weighted features."""
        return bool(self.weights) or not self.same_row

    @property
    def numbers(self) -> tuple[str, ...]:
        """Columns of numbers, in the order features, actions, reward."""
        return (*self.features, *self.actions, *([self.reward] if self.reward else []))

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns that are read."""
        others = (self.terminal, self.episode, self.time)
        return (*self.numbers, *(name for name in others if name))

    @property
    def na_texts(self) -> tuple[str, ...]:
        """Texts that stand for no value."""
        return tuple(value for value in self.na_values if isinstance(value, str))

    @property
    def na_numbers(self) -> tuple[float, ...]:
        """Numbers that stand for no value."""
        return tuple(float(value) for value in self.na_values if not isinstance(value, str))

    def _check_roles(self) -> None:
        for what, names in (("features", self.features), ("actions", self.actions)):
            if not names:
                raise LogError(f"{what} is empty; name at least one column.")
        roles: dict[str, str] = {}
        single = {role: getattr(self, role) for role in ("reward", "terminal", "episode", "time")}
        named = [("features", name) for name in self.features]
        named += [("actions", name) for name in self.actions]
        named += [(role, name) for role, name in single.items() if name is not None]
        for role, name in named:
            if name in roles:
                both = f"{roles[name]} and {role}" if roles[name] != role else f"{role} twice"
                raise LogError(f"column {name!r} is named in {both}; a column has one role.")
            roles[name] = role
        if REWARD in (*self.features, *self.actions):
            raise LogError(
                f"{REWARD!r} is the name of the reward in a dataset and cannot be that of a "
                "feature or an action; rename the column."
            )

    def _check_outcomes(self) -> None:
        if (self.reward is None) == (not self.weights):
            which = "both" if self.reward else "neither"
            raise LogError(
                f"the schema has {which} of reward (a column) and reward_weights (of features); "
                "give one of them."
            )
        for name in self.weights:
            if name not in self.features:
                raise LogError(f"reward_weights names {name!r}, which is not among the features.")
        if (self.reward or self.terminal) and self.outcome_row is None:
            raise LogError(
                "outcome_row is missing; say whether reward and terminal of an action stand in the "
                "row `after` it, with the state that it led to, or in the `same` row."
            )
        if self.weights and self.same_row and self.unrecorded_end == "repeat":
            raise LogError(
                "unrecorded_end is repeat, but reward_weights need the recorded state; give drop."
            )

    def _check_numbers(self) -> None:
        for name, (low, high) in self.actions.items():
            if not low < high:
                raise LogError(
                    f"the bounds of action {name!r} are {low:g} and {high:g}; give the smaller "
                    "one first."
                )
        for name, least in (("history", 1), ("episode_rows", 2)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise LogError(f"{name} is {value}; give at least {least}.")
        if not 0 < self.discount <= 1:
            raise LogError(f"discount is {self.discount:g}; give a number above 0, at most 1.")
        if self.time is not None and (self.sampling is None or not self.sampling > 0):
            raise LogError("time needs sampling, the interval of the rows; give one above 0.")
        if self.time_format is not None and self.time is None:
            raise LogError("time_format is given without time, the column that it is about.")
        if not 0 <= self.jitter < 0.5:
            raise LogError(f"jitter is {self.jitter:g}; give a share from 0 to below 0.5.")
        for name in ("delimiter", "decimal"):
            if len(getattr(self, name)) != 1:
                raise LogError(f"{name} is {getattr(self, name)!r}; give one character.")
        if self.delimiter == self.decimal:
            raise LogError(f"delimiter and decimal are both {self.decimal!r}; they must differ.")

    def _check_known(self, known: Known) -> None:
        for name, follower in known.features.items():
            if name not in self.features:
                raise LogError(f"known names {name!r}, which is not among the features.")
            if follower.action not in self.actions:
                raise LogError(
                    f"known: {name!r} follows {follower.action!r}, which is not among the actions."
                )
            low, high = self.actions[follower.action]
            if follower.gain and abs(low + high) > 1e-6 * (high - low):
                raise LogError(
                    f"known: {name!r} follows {follower.action!r}, whose bounds {low:g} to "
                    f"{high:g} are not symmetric about 0; leave it out of known."
                )
        followed = [follower.action for follower in known.features.values()]
        if sorted(followed) != sorted(self.actions):
            raise LogError(
                f"known has features for the actions {', '.join(followed) or 'none'}, but needs "
                f"exactly one for each of {', '.join(self.actions)}; else leave known out."
            )
        if not known.bounds[0] < known.bounds[1]:
            raise LogError("known: give the smaller one of bounds first.")
