"""Ask a running sweep to stop cleanly: ``python -m flows.stop sweep=NAME``."""

import time
from collections.abc import Sequence

from flows.configuration.checking import SettingsError, build_config
from flows.configuration.words import fields_of_words
from flows.door import run_door
from flows.pipeline.driver import ask_to_stop, read_driver
from flows.pipeline.remote.places import address_of
from flows.pipeline.stopping import PATIENCE
from flows.status.sweeps import SweepWords, chosen, open_store

__all__ = ["load_stop_words", "stop"]

HELP = f"""\
usage: python -m flows.stop [sweep=NAME]

Ask the driver of a sweep to stop: nothing new begins, what runs ends at its next checkpoint or,
after {PATIENCE:.0f} seconds, without one. Nothing finished is lost, and the sweep's own command
goes on. It works from any computer that sees the store. The driver ends with exit code 75.

  sweep=NAME     of a sweep that runs; may be left out if there is only one
  store=mlruns   folder of the runs
"""


def load_stop_words(words: Sequence[str]) -> SweepWords:
    """Settings from the command line.

    Raises:
        SettingsError: One sentence.
    """
    made: SweepWords = build_config(SweepWords, "", fields_of_words(words))
    return made


def stop(words: SweepWords) -> int:
    """Ask the driver and say how to go on.

    Returns:
        The exit code.

    Raises:
        SettingsError: There is no such sweep, or nobody drives it.
        ValueError: A record is damaged.
    """
    store = open_store(words)
    record = chosen(store, words.sweep)
    if record is None:
        raise SettingsError("Several sweeps may be meant; name one: sweep=NAME.")
    driver = read_driver(store.root, record.name)
    if driver is None or not ask_to_stop(store.root, driver, time.time()):
        raise SettingsError(f"No driver of sweep {record.name} runs; there is nothing to stop.")
    store.send_request(record.name)
    word = address_of(words.store) or words.store
    print(
        f"The driver of sweep {record.name} on {driver.host} (process {driver.pid}) is asked to "
        f"stop; it does so within {PATIENCE:.0f} seconds.\nLook: python -m flows.status "
        f"sweep={record.name} store={word} --watch\nContinue with: {driver.command}"
    )
    return 0


if __name__ == "__main__":
    run_door("stop", HELP, load_stop_words, stop)
