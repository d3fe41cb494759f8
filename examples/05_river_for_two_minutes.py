"""The river for two minutes, far beyond its clip; then a short loop that repeats without a seam.

The same from the shell:

    fluidlift sim demo.fluid --duration 120
    fluidlift edit demo.fluid --set duration=1.5 --set loop=true --simulate

Two minutes of the demo at its own resolution take a while; `--frames 200` shows the same in short.
"""

import numpy as np
from workbench import FIRST, bench, end

from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.look.rasterize import render
from fluidlift.pipeline import EditSession

b = bench("two_minutes", __doc__)
asset = load_asset(b.folder)
b.simulate(120.0)
volume = b.history()["volume"]
late = volume[len(volume) // 2 :]
drift = float(np.abs(late / late.mean() - 1).max())
b.check("steady to the end", drift < 0.1, f"volume of the second half within {100 * drift:.1f} % of its mean")
seconds = len(volume) * asset.interval
b.check(
    "the river does not run dry",
    float(volume[-1]) > 0.6 * volume[0],
    f"{volume[-1] / volume[0]:.2f} of the start after {seconds:.0f} s",
)
b.solids_stay_dry()
b.picture("05_after", background="terrain")

edits = EditSession.open(b.folder)
edits.set("loop", True)
b.simulate(1.5)
count = read_manifest(b.folder)["simulation"]["frames"]


def seen(number: int) -> np.ndarray:
    """The fluid from the clip's camera."""
    return render(b.splats(number)[0], asset.camera).image


seam = float(np.abs(seen(FIRST + count - 1) - seen(FIRST)).mean())
steps = [float(np.abs(seen(FIRST + k) - seen(FIRST + k + 1)).mean()) for k in range(0, count - 1, max(1, count // 8))]
b.check(
    "the loop has no seam",
    seam <= 1.25 * max(steps),
    f"change at the seam {seam:.4f}, between frames {np.mean(steps):.4f}",
)
b.film("05_loop", background="terrain")
end(b)
