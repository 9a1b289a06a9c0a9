"""Put a stored policy into a folder for the console: ``python -m flows.pack_policy run=ID``."""

from collections.abc import Sequence
from pathlib import Path

from pydantic import Field

from components.operating.operable import is_packed
from flows.command_line import run_door
from flows.configuration.checking import SettingsError, StoreFolder, StrictModel, build_config
from flows.configuration.words import fields_of_words
from flows.pipeline.remote.bringing import bring
from flows.pipeline.store import ArtifactStore
from flows.stored_policy import find_policy, open_operable

__all__ = ["PackSettings", "load_pack_settings", "pack"]

HELP = """\
usage: python -m flows.pack_policy run=ID to=FOLDER [KEY=VALUE ...]

Put a stored policy into a folder that flows.console opens without a store: its last snapshot, the
clone of the behaviour, the card of the log, and some of the log's states, which tell what is
familiar. A few hundred KB, no pickle.

  run=ID          id of the policy's run in MLflow, its key (the folder in mlruns/nodes) or its
                  name, e.g. lion/mediocre-0.2/seed0
  to=FOLDER       that does not exist yet, e.g. turbine
  overwrite=true  replace a folder that an earlier call has made, once the new one is complete
  store=mlruns    folder of the runs
"""


class PackSettings(StrictModel):
    """Which policy to put where."""

    run: str = Field(min_length=1)
    to: Path
    overwrite: bool = False
    store: StoreFolder = Path("mlruns")


def load_pack_settings(words: Sequence[str]) -> PackSettings:
    """Settings from the command line.

    Raises:
        SettingsError: One sentence.
    """
    fields = fields_of_words(words, on_off=["overwrite"])
    for name in ("run", "to"):
        if not fields.get(name):
            raise SettingsError(f"{name}= is missing; write run=ID to=FOLDER.")
    settings: PackSettings = build_config(PackSettings, "", fields)
    if settings.to.exists():
        if not is_packed(settings.to):
            raise SettingsError(
                f"to={settings.to} is there and is no packed policy; name another folder."
            )
        if not settings.overwrite:
            raise SettingsError(
                f"to={settings.to} is there already; name another folder, or add overwrite=true."
            )
    return settings


def pack(settings: PackSettings) -> int:
    """Write the folder.

    Returns:
        The exit code.

    Raises:
        SettingsError: There is no such policy.
        DamagedFileError: An artifact is damaged.
    """
    bring(settings.store)
    store = ArtifactStore(settings.store, create=False)
    record = find_policy(store, settings.run)
    operable = open_operable(store, record)
    operable.save(settings.to.resolve(), overwrite=settings.overwrite)  # not a link to it
    size = sum(path.stat().st_size for path in settings.to.rglob("*") if path.is_file())
    print(f"{settings.to}: {record['name']}, {size / 1000:.0f} KB.")
    return 0


if __name__ == "__main__":
    run_door("pack_policy", HELP, load_pack_settings, pack)
