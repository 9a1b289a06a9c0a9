"""The open windows: how many there are, and what leaves with each."""

from typing import Final

from nicegui import Client

__all__ = ["Windows"]

_MOST: Final = 20


class Windows:
    """All windows with a session; a closed one is forgotten, and its session with it."""

    def __init__(self) -> None:
        self._open: set[str] = set()

    def __len__(self) -> int:
        return len(self._open)

    def enter(self, client: Client) -> bool:
        """Count a window until it is closed; False if there are too many."""
        if len(self._open) >= _MOST:
            return False
        self._open.add(client.id)
        client.on_delete(lambda: self._open.discard(client.id))
        return True
