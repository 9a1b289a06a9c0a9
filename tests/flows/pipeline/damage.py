"""The ways in which a file is damaged."""

from pathlib import Path

__all__ = ["DAMAGES", "damage"]

DAMAGES = ("flipped", "truncated", "emptied", "missing")


def damage(path: Path, kind: str) -> None:
    """Damage a file in place: one bit in its middle, its last byte, all of it.

    Files may have a second name in the tracker's folders; that one is left alone.
    """
    content = bytearray(path.read_bytes())
    path.unlink()
    if kind == "flipped":
        content[len(content) // 2] ^= 1
    elif kind == "truncated":
        del content[-1]
    elif kind == "emptied":
        content.clear()
    elif kind == "foreign":
        content[:] = b"something else"
    if kind != "missing":
        path.write_bytes(content)
