"""MuJoCo itself, imported whatever MUJOCO_GL says.

MuJoCo looks for a drawing library when it is imported, and fails if the one that MUJOCO_GL names is
missing or unknown. Simulations draw nothing, so here the import is tried again without the
variable; :mod:`components.environments.rendering` says what is wrong with the library.
"""

import os
from typing import Final

__all__ = ["DRAWING_CHOICE", "mujoco"]

DRAWING_CHOICE: Final = "MUJOCO_GL"
"""The environment variable that names a drawing library."""

try:
    import mujoco
except Exception:  # whatever the library or its bindings stumble over
    _named = os.environ.pop(DRAWING_CHOICE, None)
    if _named is None:
        raise
    try:
        import mujoco
    finally:
        os.environ[DRAWING_CHOICE] = _named
