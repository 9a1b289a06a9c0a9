"""The file that holds the best settings of a search, for people and for benchmark runs.

    conf/tuned/DATASET/MODEL.yaml

It holds every setting of the model, so that a benchmark fits exactly what the search has fitted,
and where the settings come from.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from components.core.files import write_text

__all__ = ["TunedModel", "read_tuned", "tuned_path", "write_tuned"]

_HEAD = (
    "# Written by flows.tune_models, used by `models=tuned`. Search again rather than edit it.\n"
)


@dataclass(frozen=True, kw_only=True)
class TunedModel:
    """Settings of a model that a search has found.

    Attributes:
        dataset: Name of the dataset.
        model: Name of the model.
        study: Name of the study.
        trial: Number of the best trial in it.
        trials: Trials of the study that had ended.
        validation_loss: Held-out loss of the best trial.
        default_validation_loss: That of the configuration the search started from, if it has one.
        data_digest: Digest of the dataset's content.
        data_key: Key of the dataset's node.
        date: Of the file, ISO 8601.
        settings: Every setting of the model.
    """

    dataset: str
    model: str
    study: str
    trial: int
    trials: int
    validation_loss: float
    default_validation_loss: float | None
    data_digest: str
    data_key: str
    date: str
    settings: Mapping[str, Any]


def tuned_path(folder: Path, dataset: str, model: str) -> Path:
    """Where the file of a model on a dataset lies."""
    return folder / dataset / f"{model}.yaml"


def write_tuned(folder: Path, tuned: TunedModel) -> Path:
    """Write tuned settings, whole or not at all.

    Args:
        folder: Made if needed.
        tuned: The settings.

    Returns:
        The file.
    """
    path = tuned_path(folder, tuned.dataset, tuned.model)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {field.name: getattr(tuned, field.name) for field in fields(tuned)}
    content["settings"] = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in tuned.settings.items()
    }
    write_text(path, _HEAD + yaml.dump(content, Dumper=_Dumper, sort_keys=False))
    return path


class _Dumper(yaml.SafeDumper):
    """Lists in one line, as in the other files of conf/."""

    def represent_list(self, data: list[Any]) -> yaml.Node:
        return self.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True)


_Dumper.add_representer(list, _Dumper.represent_list)


def read_tuned(folder: Path, dataset: str, model: str) -> TunedModel | None:
    """Read tuned settings; None if there is no file.

    Raises:
        ValueError: It is damaged, or is about something else; the message does not name the file.
    """
    path = tuned_path(folder, dataset, model)
    if not path.is_file():
        return None
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError("it is not YAML") from error
    known = [field.name for field in fields(TunedModel)]
    if not isinstance(content, dict) or not isinstance(content.get("settings"), dict):
        raise ValueError("it holds no settings")
    odd = sorted(map(str, content.keys() ^ set(known)))
    if odd:
        raise ValueError(f"it must hold {', '.join(known)} and nothing else, see {odd[0]!r}")
    if (content["dataset"], content["model"]) != (dataset, model):
        raise ValueError(f"it is about {content['model']} on {content['dataset']}")
    return TunedModel(**content)
