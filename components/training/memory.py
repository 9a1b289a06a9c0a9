"""Keep freed memory in the process.

A training step of LION allocates and frees about a gigabyte in pieces of a megabyte. By default
glibc hands such pieces back to the kernel at once and gets them again as fresh zeroed pages in the
next step, which costs as much time as the arithmetic.
"""

import ctypes

__all__ = ["keep_freed_memory"]

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # mallopt's names, from malloc.h
_LARGEST_MMAP_THRESHOLD = 32 * 2**20  # glibc refuses more


def keep_freed_memory() -> bool:
    """Tell the allocator to reuse pages; returns whether it agreed (glibc only)."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    trimmed = mallopt(_TRIM_THRESHOLD, 2**31 - 1)
    return bool(trimmed and mallopt(_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD))
