"""The river for two minutes, far beyond its clip; then a short loop that repeats without a seam.

The same from the shell:

    fluidlift sim demo.fluid --duration 120 --set show.preview=false --set show.usd=false
    fluidlift edit demo.fluid --set duration=1.5 --set loop=true --simulate

Two minutes of the demo at its own resolution take half an hour and 19 GB; `--coarse` takes cells twice as wide, and
`--frames 200` shows the same in short. Nobody watches a preview of 3000 frames: it would take as long again.
"""

import numpy as np
from workbench import FIRST, bench, end

from fluidlift.look.rasterize import render
from fluidlift.present.looping import seam
from fluidlift.scene import EditSession

LONG, LOOP = 120.0, 1.5
"""s"""

b = bench("two_minutes", __doc__)
asset, footage = b.asset, b.footage()
assert footage is not None, "the loop is held against the clip: give an asset with its folder work/"
edits = EditSession.open(b.folder)
edits.set("duration", LONG)
b.edited(edits)
b.simulate(LONG, preview=False)

volume = b.history().volume
late = volume[len(volume) // 2 :]
drift = float(np.abs(late / late.mean() - 1).max())
# the inflow is steady but for the fitted fluctuation, so what is left are waves: a few per cent of the depth
b.check("steady to the end", drift < 0.1, f"volume of the second half within {100 * drift:.1f} % of its mean")
seconds = (len(volume) - 1) * asset.interval
# the level finds its own balance of inflow, slope and outlet, which need not be that of the first frame
b.check(
    "the river does not run dry",
    float(volume[-1]) > 0.7 * volume[0],
    f"{volume[-1] / volume[0]:.2f} of the start after {seconds:.0f} s",
)
b.divergence_free()
b.solids_stay_dry()
b.picture("05_after")

edits.set("duration", LOOP)
edits.set("loop", True)
b.simulate(LOOP)
plate, mask = footage.plate.astype(np.float32) / 255.0, footage.labels.fluid.mean(axis=0) > 0.5
shown = [render(b.all_splats(FIRST + k), asset.camera, background=plate).image[mask] for k in range(b.count)]
across, between, _ = seam(np.clip(np.stack(shown), 0.0, 1.0)[:, None])
clip = np.stack([f[mask] for f in footage.clip.frames])[:, None] / 255.0
own = seam(clip)[1]
# inside the clip's mask, from the clip's camera: the seam is one step of the loop, with as many patches that give way
# as in any other, so it is held against their mean, and that against the clip's (of eight, uncertain by a thirtieth).
# Frames of two unrelated instants differ by 1.2 to 1.4 times the clip's mean
b.check(
    "the loop has no seam",
    across <= 1.05 * between and between <= 1.05 * own,
    f"change at the seam {across:.4f}, between the loop's other frames {between:.4f}, of the clip {own:.4f} (sRGB, 0 "
    "to 1)",
)
b.film("05_loop")
end(b)
