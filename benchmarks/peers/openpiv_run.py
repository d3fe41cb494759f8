"""OpenPIV on pairs of grey pictures; run by `velocimetry.py` with an interpreter that has the package (GPL).

    python benchmarks/peers/openpiv_run.py pairs.npz vectors.npz

Reads `first` and `second`, u8 [N,H,W]. Writes x, y (px, of the middles of the windows), u, v [N,h,w] (px, +x right,
+y down) and valid [N,h,w]. Settings are the package's own (`PIVSettings`): window deformation in three passes with
windows of 64, 32 and 16 px, half overlapping, its own validation.
"""

from __future__ import annotations

import sys

import numpy as np
from openpiv import filters, validation, windef


def vectors(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, ...]:
    """x, y, u, v, valid of one pair: `windef.simple_multipass` without its turn of the axes."""
    settings = windef.PIVSettings()
    x, y, u, v, s2n = windef.first_pass(first, second, settings)
    u, v = (np.ma.array(c, mask=np.zeros(c.shape, bool)) for c in (u, v))
    u, v = filters.replace_outliers(u, v, validation.typical_validation(u, v, s2n, settings))
    flags = np.zeros(u.shape, bool)
    for k in range(1, settings.num_iterations):
        x, y, u, v, _, flags = windef.multipass_img_deform(first, second, k, x, y, u, v, settings)
    u, v = (np.ma.filled(c, np.nan) for c in (u, v))
    return x, y, u, v, np.isfinite(u) & np.isfinite(v) & ~np.asarray(flags, bool)


def main() -> None:
    """Command line."""
    pairs = np.load(sys.argv[1], allow_pickle=False)
    found = [vectors(a.astype(np.int32), b.astype(np.int32)) for a, b in zip(pairs["first"], pairs["second"])]
    x, y = found[0][:2]
    u, v, valid = (np.stack([f[k] for f in found]) for k in (2, 3, 4))
    np.savez(sys.argv[2], x=x, y=y, u=u, v=v, valid=valid)


if __name__ == "__main__":
    main()
