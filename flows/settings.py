"""From conf/ and the command line to checked, frozen settings.

Hydra's compose API joins the files of conf/ with a profile and the overrides; strict pydantic
models check every key and range. Whatever is wrong ends in one sentence that names the valid
choices.
"""

import dataclasses
import difflib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import ConfigDict, Field, ValidationError

from components.algorithms import ALGORITHMS
from components.data.experts.online import ExpertConfig
from components.data.industrial import IndustrialSpec
from components.data.robots import ROBOTS
from components.evaluation.real import EvaluationConfig
from components.models import MODELS
from flows.checking import SettingsError, build_config, check_group, sentence
from flows.sections import (
    AggregationSettings,
    DataSettings,
    EvaluationSettings,
    ExpertsSettings,
    ModelsSettings,
    RunnerSettings,
    Strict,
    TrainingSettings,
    TuningSettings,
)

__all__ = ["ALIASES", "CONF", "Settings", "SettingsError", "load_settings"]

CONF = Path(__file__).resolve().parents[1] / "conf"

ALIASES: Mapping[str, str] = {"models": "models.source"}
"""Short keys of the command line and what they stand for; a door may have others."""


class Settings(Strict):
    """A complete, checked configuration.

    Attributes:
        variants: By algorithm, one of its settings and the values it takes one after the other.
        model_words: By model, the first word of the command line that changes a setting of it.
        dataset: Every dataset of conf/dataset by name, with sizes filled in.
        algorithm: Configuration object of every algorithm by name.
        model: Configuration object of every supervised model by name.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    profile_name: str
    datasets: tuple[str, ...]
    algorithms: tuple[str, ...]
    seeds: tuple[int, ...]
    sweep: str | None = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    data: DataSettings
    training: TrainingSettings
    evaluation: EvaluationSettings
    aggregation: AggregationSettings
    runner: RunnerSettings
    models: ModelsSettings
    tuning: TuningSettings
    experts: ExpertsSettings
    variants: dict[str, tuple[str, tuple[float, ...]]]
    model_words: dict[str, str]
    store: Path
    dry_run: bool
    dataset: dict[str, IndustrialSpec]
    algorithm: dict[str, Any]
    model: dict[str, Any]


def _names(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def _hint(word: str, valid: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, list(valid), n=1)
    return f" Did you mean {close[0]!r}?" if close else ""


def load_settings(overrides: Sequence[str], aliases: Mapping[str, str] = ALIASES) -> Settings:
    """Compose and check a configuration.

    Args:
        overrides: Command line words such as ``profile=quick`` or ``seeds=[0,1]``.
        aliases: Short keys and what they stand for.

    Raises:
        SettingsError: Unknown key, name or value; one sentence.
    """
    profile = "paper"
    rest = []
    for word in overrides:
        key, equals, value = word.partition("=")
        if not equals or not key or key[0] in "+~":
            raise SettingsError(f"{word!r} is not an override; write key=value, e.g. seeds=[0,1].")
        if key == "profile":
            profile = value
        else:
            rest.append(f"{aliases.get(key, key)}={value}")
    if profile not in _names("profile"):
        raise SettingsError(
            f"Unknown profile {profile!r}; valid ones are {', '.join(_names('profile'))}."
            + _hint(profile, _names("profile"))
        )
    base = _compose(profile)
    _check_keys(rest, base)
    model_words: dict[str, str] = {}
    for word in rest:
        if word.startswith("model."):
            model_words.setdefault(word.split(".")[1], word)
    try:
        merged = OmegaConf.merge(base, _parse(rest))
        return _check(merged, model_words)  # type: ignore[arg-type]
    except OmegaConfBaseException as error:
        raise SettingsError(f"{_first_line(error)}; write a plain value.") from error


@cache
def _compose(profile: str) -> DictConfig:
    """The files of conf/ joined with a profile; not to be changed by the caller."""
    groups = [
        f"+{group}=[{','.join(_names(group))}]" for group in ("dataset", "algorithm", "model")
    ]
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            # The groups come first, so that the profile's budgets win over their defaults.
            base = compose("groups", overrides=groups)
            chosen = compose("config", overrides=[f"profile={profile}"])
            OmegaConf.set_struct(base, False)
            merged = OmegaConf.merge(base, chosen)
            OmegaConf.set_struct(merged, True)
            return merged  # type: ignore[return-value]
    except (HydraException, OmegaConfBaseException) as error:
        raise SettingsError(_first_line(error)) from error


def _parse(overrides: Sequence[str]) -> DictConfig:
    """Values of overrides by Hydra's grammar, as a nested configuration."""
    parsed = OmegaConf.create({})
    parser = OverridesParser.create()
    for word in overrides:
        try:
            override = parser.parse_override(word)
        except HydraException as error:
            raise SettingsError(
                f"{word!r} cannot be read; write key=value with lists as [a,b]."
            ) from error
        if override.is_sweep_override():
            raise SettingsError(
                f"{override.input_line!r} lists values without brackets; write "
                f"{override.key_or_group}=[...]."
            )
        OmegaConf.update(parsed, override.key_or_group, override.value(), force_add=True)
    return parsed


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def _check_keys(overrides: Sequence[str], base: DictConfig) -> None:
    """Name the valid siblings of the first unknown key."""
    for word in overrides:
        if word.startswith("dataset."):
            raise SettingsError(
                f"{word!r}: dataset names hold dots, so their keys cannot be given here; edit "
                "conf/dataset, or select with datasets=[...]."
            )
        node: Any = base
        walked: list[str] = []
        for part in word.partition("=")[0].split("."):
            if not isinstance(node, DictConfig) or part not in node:
                valid = sorted(map(str, node)) if isinstance(node, DictConfig) else []
                place = f" in {'.'.join(walked)}" if walked else ""
                listing = f"; valid keys{place}: {', '.join(valid)}" if valid else ""
                unknown = ".".join([*walked, part])
                raise SettingsError(f"Unknown key {unknown!r}{listing}.{_hint(part, valid)}")
            node = node[part]
            walked.append(part)


def _check(config: DictConfig, model_words: Mapping[str, str]) -> Settings:
    values: Any = OmegaConf.to_container(config, resolve=True)
    values["model_words"] = dict(model_words)
    for group in ("dataset", "algorithm", "model"):
        check_group(group, values[group])
    if values["store"] == "":
        raise SettingsError("store= is empty; name a folder, e.g. store=mlruns.")
    values["datasets"] = _select("dataset", values["datasets"], _names("dataset"))
    values["algorithms"] = _select("algorithm", values["algorithms"], _names("algorithm"))
    values["seeds"] = _seeds(values["seeds"])
    try:
        data = build_config(DataSettings, "data", values["data"])
        sizes = {"trajectories": data.trajectories, "steps": data.steps}
        values["dataset"] = {
            name: build_config(IndustrialSpec, f"dataset.{name}", {"name": name, **fields, **sizes})
            for name, fields in values["dataset"].items()
        }
        for group, known in (("algorithm", _algorithm_configs()), ("model", _model_configs())):
            values[group] = {
                name: build_config(known[name], f"{group}.{name}", fields)
                for name, fields in values[group].items()
            }
        sections = (
            ("training", TrainingSettings),
            ("evaluation", EvaluationSettings),
            ("aggregation", AggregationSettings),
            ("runner", RunnerSettings),
            ("models", ModelsSettings),
            ("tuning", TuningSettings),
            ("experts", ExpertsSettings),
        )
        check_group("tuning", values["tuning"])
        values["tuning"]["models"] = _select(
            "model", values["tuning"].get("models"), _names("model")
        )
        check_group("experts", values["experts"])
        values["experts"] = _experts(values["experts"])
        values |= {name: build_config(kind, name, values[name]) for name, kind in sections}
        values["data"] = data
        values["variants"] = _variants(values)
        settings = Settings(**values)
        EvaluationConfig(**settings.evaluation.model_dump())
    except ValidationError as error:
        raise SettingsError(sentence(error, "")) from error
    except ValueError as error:
        raise SettingsError(str(error)) from error
    _check_snapshots(settings)
    return settings


def _algorithm_configs() -> Mapping[str, type]:
    return {name: module.Config for name, module in ALGORITHMS.items()}


def _model_configs() -> Mapping[str, type]:
    return {name: kind.config for name, kind in MODELS.items()}


def _variants(values: dict[str, Any]) -> dict[str, tuple[str, tuple[float, ...]]]:
    """Takes the options that ask for several policies of one algorithm."""
    penalties = values.pop("mopo_penalties")
    if penalties is None:
        return {}
    if penalties == "sweep":
        penalties = [round(0.1 * k, 1) for k in range(26)]  # thesis 6.3
    chosen = penalties if isinstance(penalties, list) else [penalties]
    numbers = all(isinstance(p, int | float) and not isinstance(p, bool) for p in chosen)
    if not chosen or not numbers or len(set(chosen)) != len(chosen):
        raise SettingsError(
            f"mopo_penalties={penalties} must be null, sweep or a list of different numbers."
        )
    if "mopo" not in values["algorithms"]:
        raise SettingsError(
            "mopo_penalties is given, but mopo is not among the algorithms; add it."
        )
    for penalty in chosen:
        try:
            dataclasses.replace(values["algorithm"]["mopo"], penalty=float(penalty))
        except ValueError as error:
            raise SettingsError(f"mopo_penalties={penalties}: {error}") from error
    return {"mopo": ("penalty", tuple(map(float, chosen)))}


def _check_snapshots(settings: Settings) -> None:
    for name in settings.algorithms:
        updates = settings.algorithm[name].updates
        if updates < settings.training.snapshots:
            raise SettingsError(
                f"algorithm.{name}.updates={updates} is less than training.snapshots="
                f"{settings.training.snapshots}; raise the one or lower the other."
            )


def _experts(values: Mapping[str, Any]) -> dict[str, Any]:
    """The section of the experts with its names, seeds and training checked."""
    return {
        **values,
        "robots": _select("robot", values.get("robots"), list(ROBOTS)),
        "seeds": _seeds(values.get("seeds")),
        "training": build_config(ExpertConfig, "experts.training", values.get("training")),
    }


def _seeds(chosen: Any) -> list[int]:
    seeds = chosen if isinstance(chosen, list) else [chosen]
    if not seeds or len(set(map(str, seeds))) != len(seeds):
        raise SettingsError(f"seeds={seeds} must be a list of different whole numbers.")
    if any(isinstance(seed, bool) or not isinstance(seed, int) or seed < 0 for seed in seeds):
        raise SettingsError(f"seeds={seeds} must hold whole numbers from 0.")
    return seeds


def _select(group: str, chosen: Any, valid: list[str]) -> list[str]:
    if chosen == "all":
        return valid
    names = [str(name) for name in (chosen if isinstance(chosen, list) else [chosen])]
    if not names:
        raise SettingsError(f"{group}s=[] selects nothing; valid ones are {', '.join(valid)}.")
    for name in names:
        if name not in valid:
            raise SettingsError(
                f"Unknown {group} {name!r}; valid ones are {', '.join(valid)}, or all."
                + _hint(name, valid)
            )
    if len(set(names)) != len(names):
        raise SettingsError(f"{group}s={names} names one twice.")
    return names
