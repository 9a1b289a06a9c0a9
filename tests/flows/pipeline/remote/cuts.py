"""A store that stops answering, or a process that dies, after any number of single operations."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

from flows.pipeline.errors import StoreError
from flows.pipeline.remote.objects import Objects

_ONE_BY_ONE = ("upload", "delete", "download")  # each of their objects is an operation
_AT_ONCE = ("read", "read_many", "write", "create", "sizes")


class Killed(BaseException):
    """The process is dead: nothing catches this, and nothing it does after that has an effect."""


def cut(objects: Objects, after: int, error: type[BaseException]) -> Callable[[], bool]:
    """Lets some operations happen and none after those.

    Args:
        objects: Of the store.
        after: How many operations happen.
        error: What the next ones raise.

    Returns:
        Tells whether one was refused.
    """
    left, refused = after, False

    def one(operation: Callable[..., Any], *words: Any, **named: Any) -> Any:
        nonlocal left, refused
        if left == 0:
            refused = True
            raise error("the store is away")
        left -= 1
        return operation(*words, **named)

    def wrapped(name: str) -> Callable[..., Any]:
        operation = getattr(objects, name)

        def single(words: Any) -> Any:
            if name not in _ONE_BY_ONE:
                return one(operation, words)
            pairs = words.items() if isinstance(words, dict) else ((word, None) for word in words)
            done = [
                one(operation, {word: file} if name != "delete" else [word])
                for word, file in list(pairs)
            ]
            return all(done)

        return single if name not in ("write", "create") else lambda *w: one(operation, *w)

    for name in (*_ONE_BY_ONE, *_AT_ONCE):
        setattr(objects, name, wrapped(name))
    return lambda: refused


def cuts(begin: Callable[[], Any], act: Callable[[Any], Any]) -> Iterator[int]:
    """Does something again and again, each time cut off one operation later, until it gets through.

    Args:
        begin: Prepares everything anew and returns the store.
        act: What is cut off.

    Yields:
        After each time, how many operations there were.
    """
    for error in (StoreError, Killed):
        for after in range(200):
            store = begin()
            refused = cut(store.objects, after, error)
            with suppress(StoreError, Killed):
                act(store)
            yield after
            if not refused():
                break
        else:
            raise AssertionError("200 operations do not suffice")
