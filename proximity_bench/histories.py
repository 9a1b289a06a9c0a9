"""What a policy is shown: checked, and compared with what its log holds."""

import warnings
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from torch import Tensor

__all__ = ["FarFromLogWarning", "checked_frames", "checked_proximity", "warn_of_strangers"]

_FAR: Final = 20.0
"""Standard deviations from a log's mean beyond which a value is hardly in the log's units: sensors
with rare peaks stay within some ten, kelvin for degrees is a hundred."""

Frames = npt.NDArray[np.float32]


class FarFromLogWarning(UserWarning):
    """A value that can hardly be one of the log's."""


def checked_frames(
    history: npt.ArrayLike | pd.DataFrame | pd.Series, features: Sequence[str]
) -> Frames:
    """Frames ``[T, F]`` or ``[B, T, F]``.

    Args:
        history: See :meth:`.Policy.act`.
        features: Names of the F values.

    Raises:
        ValueError: Other widths, or values that are missing, infinite or no numbers.
    """
    wanted = f"the {len(features)} values {', '.join(features)}"
    rows: Sequence[Any] = ()
    if isinstance(history, pd.Series):  # a row of a table
        history = history.to_frame().T
    if isinstance(history, pd.DataFrame):
        lacking = [name for name in features if name not in history.columns]
        if lacking:
            raise ValueError(f"The history lacks {', '.join(lacking)}; give {wanted}.")
        history, rows = history[list(features)], list(history.index)
    try:
        frames = np.asarray(history, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise ValueError(f"The history holds no plain numbers ({error}).") from error
    if frames.ndim not in (2, 3) or 0 in frames.shape:
        raise ValueError(
            f"The history has the shape {frames.shape}; give [T, F] frames in the order of "
            f"time, or [B, T, F], of {wanted}."
        )
    if frames.shape[-1] != len(features):
        raise ValueError(f"The history has {frames.shape[-1]} values a frame; give {wanted}.")
    wrong = ~np.isfinite(frames)
    if wrong.any():
        *_, frame, value = place = np.argwhere(wrong)[0]
        where = f"row {rows[frame]}" if rows else f"frame {frame}"
        raise ValueError(
            f"The history holds {frames[tuple(place)]} for {features[value]!r} in {where}; the "
            "policy needs every value."
        )
    return frames


def checked_proximity(
    given: npt.ArrayLike | None, machines: int, algorithm: str, *, wanted: bool
) -> Tensor | None:
    """Proximities ``[1, B]``; None where none is wanted.

    Args:
        given: See :meth:`.Policy.act`.
        machines: B.
        algorithm: Of the policy.
        wanted: Whether the policy takes a proximity.

    Raises:
        ValueError: It is missing, outside of [0, 1], or not wanted.
    """
    if (given is not None) != wanted:
        if given is None:
            raise ValueError(
                f"A policy of {algorithm} needs proximity; give a number from 0, as it was always "
                "done, to 1, what the model thinks is best."
            )
        raise ValueError(f"A policy of {algorithm} takes no proximity; leave it out.")
    if given is None:
        return None
    try:
        values = np.broadcast_to(np.asarray(given, dtype=np.float32), (machines,))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"proximity={given!r} is neither a number nor one for each of {machines} histories."
        ) from error
    if not ((values >= 0) & (values <= 1)).all():
        raise ValueError(f"proximity={given!r} must lie in [0, 1].")
    return torch.from_numpy(values.copy())[None]


def warn_of_strangers(frames: Frames, features: Sequence[str], mean: Tensor, scale: Tensor) -> None:
    """Warn if values can hardly be the log's, e.g. in another unit or in another order.

    Args:
        frames: ``[..., F]``.
        features: Names of the F values.
        mean: ``[F]`` of the log.
        scale: ``[F]`` standard deviations; exactly 1 for a value that never changes in the log,
            which is not looked at.
    """
    deviations = np.where(scale == 1.0, np.inf, scale)
    far = np.abs(frames - mean.numpy()) / deviations
    worst = tuple(int(n) for n in np.unravel_index(int(far.argmax()), far.shape))
    if far[worst] > _FAR:
        name, usual = features[worst[-1]], float(mean[worst[-1]])
        warnings.warn(
            f"{name} is {frames[worst]:g}, {far[worst]:.0f} standard deviations from its mean "
            f"of {usual:g} in the log: are the values in the log's units and order? The policy "
            "knows nothing of such states.",
            FarFromLogWarning,
            stacklevel=3,
        )
