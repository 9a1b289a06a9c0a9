"""Film a policy, of a robot or beside the behaviour: ``python -m flows.render run=ID out=FILE``."""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from pydantic import Field

from components.data.card import DatasetCard
from components.environments.rendering import DRAWABLE, film, pictures_per_second
from components.operating.operable import SHIPPED, Operable, newest, packed_folders
from components.operating.session import Session
from components.policies.policy import Policy, PolicyCard
from flows.command_line import run_door
from flows.configuration.checking import SettingsError, StoreFolder, StrictModel, build_config
from flows.configuration.words import fields_of_words
from flows.pipeline.remote.bringing import bring
from flows.pipeline.store import ArtifactStore
from flows.stored_policy import find_policy, open_operable
from flows.video import video

__all__ = ["RenderSettings", "load_render_settings"]

HELP = """\
usage: python -m flows.render run=ID out=FILE [KEY=VALUE ...]

Film a policy; the last snapshot acts. A robot is drawn without a screen by EGL or OSMesa. Any other
system is shown as in flows.console: over time, or on the map of the 2-D world, with the behaviour
beside it from the same start and with the same noise.

  run=ID         id of the policy's run in MLflow, its key (the folder in mlruns/nodes) or its name,
                 e.g. td3_bc/hopper/seed0; or a shipped policy: turbine, world
  out=FILE       a file that ends in .mp4 or .gif, e.g. walker.mp4
  lambda=0.5     for policies that take it, from 0 to 1; lambda=0..1 turns it during the film
  steps=1000     at most; a fall ends the film of a robot; 200 for other systems
  seed=0         of the start state
  size=480       of a robot's picture in pixels, a multiple of 16
  store=mlruns   folder of the runs
"""

_OTHER_NAMES = {"lambda": "proximity"}
_TO = ".."  # between the proximities at the beginning and at the end
_STEPS = {True: 1000, False: 200}  # of a robot, of another system
_PER_SECOND = 12.0  # pictures of another system
_HELD = 0.15  # share of the film at either end in which the proximity stays
_PICTURES = 150  # of another system at most, as each takes a tenth of a second to draw


class RenderSettings(StrictModel):
    """What to film and where to write it."""

    run: str = Field(min_length=1)
    out: Path
    proximity: float | None = Field(default=None, ge=0, le=1)
    steps: int | None = Field(default=None, ge=1)
    seed: int = Field(default=0, ge=0)
    size: int = Field(default=480, ge=16, multiple_of=16)  # blocks of video codecs
    store: StoreFolder = Path("mlruns")
    last_proximity: float | None = Field(default=None, ge=0, le=1)

    def proximity_at(self, step: int, steps: int) -> float | None:
        """The proximity of a step: turned evenly in the middle of the film, held at its ends."""
        first, last = self.proximity, self.last_proximity
        if first is None or last is None:
            return first
        part = (step / max(1, steps - 1) - _HELD) / (1 - 2 * _HELD)
        return first + (last - first) * min(1.0, max(0.0, part))


def load_render_settings(words: Sequence[str]) -> RenderSettings:
    """Settings from the command line.

    Raises:
        SettingsError: One sentence.
    """
    fields = fields_of_words(words, other_names=_OTHER_NAMES)
    if "last_proximity" in fields:
        raise SettingsError("last_proximity is written lambda=0..1.")
    if _TO in fields.get("proximity", ""):
        fields["proximity"], _, fields["last_proximity"] = fields["proximity"].partition(_TO)
    for name in ("run", "out"):
        if name not in fields:
            raise SettingsError(f"{name}= is missing; write run=ID out=FILE, e.g. out=walker.mp4.")
    settings: RenderSettings = build_config(RenderSettings, "", fields)
    if settings.out.suffix.lower() not in (".mp4", ".gif"):
        raise SettingsError(f"out={settings.out} must end in .mp4 or .gif.")
    return settings


def _actor(
    policy: Policy, settings: RenderSettings, steps: int
) -> Callable[[np.ndarray], np.ndarray]:
    """Frames `[1, H, F]` to the last snapshot's action `[A]`."""
    card = policy.card
    _check_proximity(card, settings)
    last = newest(policy)
    generator = np.random.default_rng(settings.seed)
    taken = itertools.count()

    def act(frames: np.ndarray) -> np.ndarray:
        noise = None
        if card.candidates:
            drawn = generator.standard_normal((1, 1, card.candidates, card.noise), np.float32)
            noise = torch.from_numpy(drawn)
        seen = torch.from_numpy(frames).float()[None]
        given = settings.proximity_at(next(taken), steps)
        proximity = None if given is None else torch.tensor([[given]])
        return last.act(seen, proximity, noise)[0, 0].numpy()

    return act


def _check_proximity(card: PolicyCard, settings: RenderSettings) -> None:
    takes = card.takes_proximity
    if takes != (settings.proximity is not None):
        needs = "needs proximity; add e.g. proximity=0.5, or lambda=0..1"
        says = needs if takes else "takes no proximity"
        raise SettingsError(f"run={settings.run}: a policy of {card.algorithm} {says}.")


def _run(settings: RenderSettings) -> int:
    shipped = packed_folders(SHIPPED).get(settings.run)
    if shipped is not None:
        return _film_session(settings, Operable.load(shipped), settings.run)
    bring(settings.store)
    store = ArtifactStore(settings.store, create=False)
    record = find_policy(store, settings.run)
    card = DatasetCard.load(store.path(record["inputs"]["dataset"]) / "dataset" / "card.json")
    if card.environment not in DRAWABLE:
        return _film_session(settings, open_operable(store, record), record["name"])
    policy = Policy.load(store.path(record["key"]) / "policy")
    steps = settings.steps or _STEPS[True]
    act = _actor(policy, settings, steps)
    per_second = pictures_per_second(card.environment, card.environment_parameters)
    with video(settings.out, per_second) as draw:
        take = film(
            card.environment,
            card.environment_parameters,
            act,
            draw,
            history=policy.card.history,
            steps=steps,
            seed=settings.seed,
            size=settings.size,
        )
    end = "until it fell" if take.fell else "without a fall"
    print(
        f"{settings.out}: {record['name']} for {take.steps} steps ({take.seconds:.1f} s) {end}; "
        f"undiscounted return {take.reward:.1f}."
    )
    return 0


def _film_session(settings: RenderSettings, operable: Operable, name: str) -> int:
    """Film a system that no camera sees, or recorded states."""
    _check_proximity(operable.policy.card, settings)
    from components.operating.scene import Scene  # draws with Matplotlib, which robots do without

    steps = settings.steps or _STEPS[False]
    session = Session(operable, settings.seed)
    scene = Scene(session, steps)
    every = -(-steps // _PICTURES)
    sums = np.zeros(2)
    with video(settings.out, _PER_SECOND) as draw:
        for step in range(steps):
            proximity = settings.proximity_at(step, steps)
            if proximity is not None:
                session.proximity = proximity
            sums += scene.step().rewards
            if step % every == 0 or step == steps - 1:
                draw(scene.picture())
    print(
        f"{settings.out}: {name} for {steps} steps; sum of rewards {sums[0]:.1f}, of the behaviour "
        f"beside it {sums[1]:.1f}."
    )
    return 0


if __name__ == "__main__":
    run_door("render", HELP, load_render_settings, _run)
