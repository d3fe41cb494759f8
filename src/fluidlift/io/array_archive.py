"""Arrays of an npz that may come from anyone."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected

_MAX_ARRAYS = 8 * 2**30


def read_arrays(path: Path, needed: Sequence[str]) -> dict[str, np.ndarray]:
    """The arrays of an npz; pickles and oversize content are refused before anything is unpacked.

    Args:
        path: of the file.
        needed: names that must be there.

    Raises:
        InputRejected: a damaged or oversize file, one without a needed array, or numbers that are not finite.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > _MAX_ARRAYS:
                raise InputRejected(f"'{path.name}' unpacks to too much", f"at most {_MAX_ARRAYS} bytes")
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, NotImplementedError, MemoryError) as error:
        raise InputRejected(f"'{path.name}' cannot be read ({error})", "an undamaged asset", "make it again") from None
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise InputRejected(f"'{path.name}' lacks {', '.join(missing)}", "a whole asset", "make it again")
    bad = [
        n for n, a in arrays.items() if a.dtype.kind not in "fiub" or (a.dtype.kind == "f" and not np.isfinite(a).all())
    ]
    if bad:
        raise InputRejected(f"'{path.name}' holds {', '.join(bad)} with no finite numbers", "a whole asset")
    return arrays
