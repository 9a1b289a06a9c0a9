"""Watch a stored policy: ``python -m flows.render run=td3_bc/hopper/seed0 out=hopper.mp4``."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import Field

from components.data.card import DatasetCard
from components.environments.rendering import DRAWABLE, film, pictures_per_second
from components.policies.policy import Policy
from flows.command_line import run_door
from flows.configuration.checking import SettingsError, StoreFolder, StrictModel, build_config
from flows.configuration.overrides import split_word
from flows.pipeline.remote.bringing import bring
from flows.pipeline.store import ArtifactStore
from flows.stored_policy import find_policy
from flows.video import video

__all__ = ["RenderSettings", "load_render_settings"]

HELP = """\
usage: python -m flows.render run=ID out=FILE [KEY=VALUE ...]

Film a stored policy of a robot, drawn without a screen by EGL or OSMesa. The last snapshot acts.

  run=ID         id of the policy's run in MLflow, its key (the folder in mlruns/nodes) or its name,
                 e.g. td3_bc/hopper/seed0
  out=FILE       a file that ends in .mp4 or .gif, e.g. walker.mp4
  proximity=0.5  for policies that take it, from 0 to 1
  steps=1000     at most; a fall ends the film
  seed=0         of the start state
  size=480       of the picture in pixels, a multiple of 16
  store=mlruns   folder of the runs
"""

_FORMER_KEYS = {"lambda": "proximity"}
"""Old keys that stored reports name, and the keys of today."""


class RenderSettings(StrictModel):
    """What to film and where to write it."""

    run: str = Field(min_length=1)
    out: Path
    proximity: float | None = Field(default=None, ge=0, le=1)
    steps: int = Field(default=1000, ge=1)
    seed: int = Field(default=0, ge=0)
    size: int = Field(default=480, ge=16, multiple_of=16)  # blocks of video codecs
    store: StoreFolder = Path("mlruns")


def load_render_settings(words: Sequence[str]) -> RenderSettings:
    """Settings from the command line.

    Raises:
        SettingsError: One sentence.
    """
    fields: dict[str, Any] = {}
    for word in words:
        key, value = split_word(word)
        key = _FORMER_KEYS.get(key, key)
        if fields.setdefault(key, value) != value:
            raise SettingsError(f"{key} is given twice; give it once.")
    for name in ("run", "out"):
        if name not in fields:
            raise SettingsError(f"{name}= is missing; write run=ID out=FILE, e.g. out=walker.mp4.")
    settings: RenderSettings = build_config(RenderSettings, "", fields)
    if settings.out.suffix.lower() not in (".mp4", ".gif"):
        raise SettingsError(f"out={settings.out} must end in .mp4 or .gif.")
    return settings


def _actor(policy: Policy, settings: RenderSettings) -> Callable[[np.ndarray], np.ndarray]:
    """Frames `[1, H, F]` to the last snapshot's action `[A]`."""
    card = policy.card
    takes = card.takes_proximity
    if takes != (settings.proximity is not None):
        says = "needs proximity; add e.g. proximity=0.5" if takes else "takes no proximity"
        raise SettingsError(f"run={settings.run}: a policy of {card.algorithm} {says}.")
    last = policy.select(slice(policy.lanes - 1, policy.lanes), card)
    proximity = None if settings.proximity is None else torch.tensor([[settings.proximity]])
    generator = np.random.default_rng(settings.seed)

    def act(frames: np.ndarray) -> np.ndarray:
        noise = None
        if card.candidates:
            drawn = generator.standard_normal((1, 1, card.candidates, card.noise), np.float32)
            noise = torch.from_numpy(drawn)
        seen = torch.from_numpy(frames).float()[None]
        return last.act(seen, proximity, noise)[0, 0].numpy()

    return act


def _run(settings: RenderSettings) -> int:
    bring(settings.store)
    store = ArtifactStore(settings.store, create=False)
    record = find_policy(store, settings.run)
    card = DatasetCard.load(store.path(record["inputs"]["dataset"]) / "dataset" / "card.json")
    if card.environment not in DRAWABLE:
        raise SettingsError(
            f"run={settings.run} is a policy of {card.environment or card.name}, which has no "
            "picture; only policies of the robots can be filmed."
        )
    policy = Policy.load(store.path(record["key"]) / "policy")
    act = _actor(policy, settings)
    per_second = pictures_per_second(card.environment, card.environment_parameters)
    with video(settings.out, per_second) as draw:
        take = film(
            card.environment,
            card.environment_parameters,
            act,
            draw,
            history=policy.card.history,
            steps=settings.steps,
            seed=settings.seed,
            size=settings.size,
        )
    end = "until it fell" if take.fell else "without a fall"
    print(
        f"{settings.out}: {record['name']} for {take.steps} steps ({take.seconds:.1f} s) {end}; "
        f"undiscounted return {take.reward:.1f}."
    )
    return 0


if __name__ == "__main__":
    run_door("render", HELP, load_render_settings, _run)
