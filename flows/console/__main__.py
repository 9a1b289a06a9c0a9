"""Turn the proximity while a machine runs, in a browser: ``python -m flows.console``."""

from collections.abc import Sequence
from pathlib import Path

from pydantic import Field

from components.evaluation.guarantee import USUAL, Guarantee
from flows.configuration.checking import SettingsError, StoreFolder, StrictModel, build_config
from flows.configuration.words import fields_of_words
from flows.door import run_door
from flows.pipeline.remote.bringing import bring
from flows.pipeline.signals import exit_code

__all__ = ["ConsoleSettings", "load_console_settings", "run"]

HELP = f"""\
usage: python -m flows.console [KEY=VALUE ...]

Open the operator's console: choose a policy, turn its proximity with a slider while the machine
runs and watch what it does beside the logged behaviour; or look at a sweep. A turbine and the 2-D
world are shipped, so nothing has to be trained. The server listens on 127.0.0.1 alone, until
Ctrl-C.

  store=mlruns   folder of the runs, whose policies are offered and whose sweeps are shown; sessions
                 are saved below its sessions/
  policies=FOLDER  a folder that flows.pack_policy has made, or one of such folders: offered, too
  margin={USUAL.margin:g}     what the autopilot may lose, as a share of the logged return
  slope={USUAL.slope:g}        how much the return may fall per unit of lambda, in the same
                 share: its guarantee holds if it falls no faster
  port=8085      of the server; by default 8085 or, where that is taken, any free one
  replay=FOLDER  instead: decide again as a saved session says, and compare every byte of it
"""


class ConsoleSettings(StrictModel):
    """Where to listen and what to offer."""

    store: StoreFolder = Path("mlruns")
    policies: Path | None = None
    margin: float = Field(default=USUAL.margin, gt=0, allow_inf_nan=False)
    slope: float = Field(default=USUAL.slope, gt=0, allow_inf_nan=False)
    port: int | None = Field(default=None, ge=1, le=65535)
    replay: Path | None = None


def load_console_settings(words: Sequence[str]) -> ConsoleSettings:
    """Settings from the command line.

    Raises:
        SettingsError: One sentence.
    """
    whole = {f"console.{name}": name for name in ConsoleSettings.model_fields}
    fields = fields_of_words(words, other_names=whole)
    settings: ConsoleSettings = build_config(ConsoleSettings, "", fields)
    if settings.policies is not None and not _offers(settings.policies):
        raise SettingsError(
            f"policies={settings.policies} holds no packed policy; give a folder that python -m "
            "flows.pack_policy run=ID to=FOLDER has made, or one of such folders."
        )
    return settings


def run(settings: ConsoleSettings) -> int:
    """Serve, or replay.

    Returns:
        The exit code.

    Raises:
        SettingsError: The port is taken, or the recording cannot be replayed here.
    """
    if settings.replay is not None:
        return _replay(settings, settings.replay)
    from flows.console.server import bound, serve  # a web server, which a replay does not need

    bring(settings.store)
    own = bound(settings.port)
    try:
        serve(
            own,
            settings.store,
            lambda at: print(f"Open {at} in a browser.", flush=True),
            settings.policies,
            Guarantee(settings.margin, settings.slope),
        )
    except KeyboardInterrupt:  # the usual end, after which there is nothing to continue
        return exit_code()
    return 0


def _offers(folder: Path) -> bool:
    from components.operating.operable import packed_folders  # imports PyTorch

    return bool(packed_folders(folder))


def _replay(settings: ConsoleSettings, folder: Path) -> int:
    from components.operating.recording import card_of, replay
    from flows.console.catalogue import Catalogue, NotOfferedError

    try:
        operable = Catalogue(settings.store, settings.policies).open(card_of(folder).policy)
    except NotOfferedError:
        raise SettingsError(
            f"replay={folder} is of a policy that store={settings.store} does not hold; name its "
            "store, or with policies= the folder of a packed one."
        ) from None
    steps = replay(folder, operable)
    print(f"{folder}: {steps} steps replayed, to the same bytes.")
    return 0


if __name__ == "__main__":
    run_door("console", HELP, load_console_settings, run)
