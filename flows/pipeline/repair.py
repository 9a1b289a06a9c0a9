"""Sets aside what cannot be used, so that it is made again; up to a limit."""

from collections import Counter
from collections.abc import Callable, Mapping

from flows.pipeline.artifacts import Artifacts
from flows.pipeline.audit import Audit

__all__ = ["Repairs"]

_REMAKES = 2  # times that a damaged node is made again in a run


class Repairs:
    """The repairs of one run.

    Args:
        store: The store.
        note: Shows a message.
    """

    def __init__(self, store: Artifacts, note: Callable[[str], None]) -> None:
        self._store, self._note = store, note
        self._times: Counter[str] = Counter()

    def set_aside(self, found: Audit, suspects: Mapping[str, str]) -> dict[str, str]:
        """Moves what cannot be used out of the way; nothing of this run may be reading it.

        Args:
            found: What the plan found in the store.
            suspects: Why an artifact could not be read, by key.

        Returns:
            By key, why a node is not worth being made once more.
        """
        damaged = {**suspects, **found.unusable}
        for key in damaged.keys() - found.stale:
            self._times[key] += 1
        for key, sentence in found.unusable.items():
            with self._store.locked([key], wait=False) as held:
                # Whoever holds the lock has found it, too, and is making it.
                if held and self._store.set_aside(key, found.places[key]):
                    kept = f"{self._store.damaged.name}/{key}"
                    self._note(f"{sentence}: it is made again (kept in {kept}).")
        return {
            key: f"{sentence}, {self._times[key]} times in this run{self._remedy(key, found)}"
            for key, sentence in damaged.items()
            if self._times[key] > _REMAKES
        }

    def _remedy(self, key: str, found: Audit) -> str:
        """What to do; a sound artifact that nobody can read is no matter of the disk."""
        if key in found.finished:
            return (
                ", though its files are what was written: whoever reads them expects others. If no "
                f"setting explains that, delete {self._store.path(key)} and give the same command "
                "again."
            )
        return f": check the disk that holds {self._store.root} and give the same command again."
