"""White water of an asset: as much as its clip shows, where it does, and what it costs.

    python benchmarks/whitewater.py ASSET [--frames 50] [--potentials]

Simulates the asset twice. As lifted, with white water everywhere (`whitewater.everywhere`), measured by the first half
of the film alone: the share of the fluid's pixels that foam covers, from the clip's camera, against that in the other
half, and the correlation of the two maps. `--potentials` leaves the film's places out: foam is born where the simulated
flow breaks, and nowhere else. Then with its scene.yaml: particles of each kind, and the processor time of the liquid
and of its white water.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from fluidlift.config import JobConfig
from fluidlift.io.asset_folder import load_asset
from fluidlift.io.scene import SceneEdits
from fluidlift.look.whitewater_splats import FilmedFoam
from fluidlift.physics.whitewater import FOAM, Ground, Whitewater, WhitewaterLaw
from fluidlift.scene.build import Scene, SimulationRequest, scene_of
from fluidlift.scene.simulator import simulator_of
from fluidlift.scene.whitewater import SETTLED, MeasuredWhitewater, measured

BLUR = 0.03
"""of the maps before they are compared, shares of the picture's width: that of a patch of foam"""


def of_scene(scene: Scene, law: Callable[[bool], WhitewaterLaw], frames: int, camera=None) -> dict:
    """Particles, processor time, and the mean picture of foam of the second half; `law` by whether the flow has
    settled."""
    ground = Ground.of(scene.terrain, scene.cell_types)
    water = Whitewater(ground, law(False), scene.parameters.gravity, scene.parameters.density, scene.seed)
    simulator, liquid, white, cover, kinds = simulator_of(scene), 0.0, 0.0, None, []
    for k in range(frames):
        begin = time.process_time()
        simulator.advance(scene.interval)
        middle = time.process_time()
        particles = simulator.particles
        water.law = law(k + 1 > round(SETTLED / scene.interval))
        water.advance(particles, scene.interval, simulator.bodies.inside if scene.obstacles else None)
        if k > 1:  # the first ones compile
            liquid, white = liquid + middle - begin, white + time.process_time() - middle
        kinds.append(np.bincount(water.kinds, minlength=3).tolist())
        if camera is not None and k >= frames // 2:
            cover = covered(water, camera, scene.terrain.grid.spacing) + (0.0 if cover is None else cover)
    found = {"kinds": kinds[-1], "born_per_second": water.next_id / (frames * scene.interval), "liquid_s": liquid,
             "white_s": white, "cost": 1 + white / liquid, "thinned": water.thinned}  # fmt: skip
    return found if cover is None else found | {"cover": cover / (frames - frames // 2)}


def covered(water: Whitewater, camera, cell: float) -> np.ndarray:
    """Pixels that foam hides, with splats as they are drawn."""
    from fluidlift.look.whitewater_splats import whitewater_splats

    picture = np.zeros((camera.size[1], camera.size[0]))
    own = water.kinds == FOAM
    splats = whitewater_splats(water.positions[own], water.kinds[own], water.lives[own], (1.0, 1.0, 1.0), cell)
    uv, depth = camera.project(splats.means)
    size = 1.5 * splats.scales.mean(axis=1) * camera.focal[0] / np.maximum(depth, 1e-6)
    rows, columns = np.indices(picture.shape) + 0.5
    clear = np.ones_like(picture)
    for (u, v), r, a in zip(uv, size, splats.opacities):
        x0, x1, y0, y1 = int(u - r - 1), int(u + r + 2), int(v - r - 1), int(v + r + 2)
        if x1 <= 0 or y1 <= 0 or x0 >= picture.shape[1] or y0 >= picture.shape[0]:
            continue
        box = slice(max(y0, 0), y1), slice(max(x0, 0), x1)
        clear[box] *= 1.0 - a * ((columns[box] - u) ** 2 + (rows[box] - v) ** 2 < max(r, 0.5) ** 2)
    return 1.0 - clear


def against_film(scene: Scene, found: MeasuredWhitewater, foam: FilmedFoam, frames: int, potentials: bool) -> dict:
    """As lifted, with white water everywhere, against a film."""
    height, width = foam.places.shape
    camera = scene.camera.resized((width, height))

    def law(settled: bool) -> WhitewaterLaw:
        own = found.law(scene, 1.0, not potentials, settled=settled)
        return replace(own, known=None) if potentials else own

    made = of_scene(scene, law, frames, camera)
    return made | compared(foam, made.pop("cover"))


def compared(foam: FilmedFoam, cover: np.ndarray) -> dict:
    """Shares, and the correlation of the blurred maps, where a film shows fluid most of the time."""
    fluid = foam.seen > 0.5
    width = BLUR * cover.shape[1]
    weight = np.maximum(ndimage.gaussian_filter(fluid.astype(float), width), 1e-6)
    maps = [ndimage.gaussian_filter(m * fluid, width)[fluid] / weight[fluid] for m in (foam.places, cover)]
    return {"share_of_film": float(foam.places[fluid].mean()), "share": float(cover[fluid].mean()),
            "correlation": float(np.corrcoef(*maps)[0, 1])}  # fmt: skip


def halves(scene: Scene) -> tuple[FilmedFoam, FilmedFoam]:
    """The foam of the first half of a scene's film, and of the second."""
    from fluidlift.io.footage_file import read_footage

    assert scene.film is not None
    frames, fluid, _ = read_footage(scene.film, scene.camera.size)
    middle = len(frames) // 2
    return FilmedFoam.of(frames[:middle], fluid[:middle]), FilmedFoam.of(frames[middle:], fluid[middle:])


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", type=Path)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--potentials", action="store_true")
    given = parser.parse_args()
    asset, request, config = load_asset(given.asset), SimulationRequest(), JobConfig()
    lifted = scene_of(asset, given.asset, request, config, footage=None, start=0, edits=SceneEdits())
    first, second = halves(lifted)
    found = measured(lifted, foam=first)
    if found is None or not second.share:
        print("the film shows no foam")
        return 0
    told = {"trapped": found.trapped, "crest": found.crest, "energy": found.energy, "rate": found.rate}
    print(json.dumps(told | {"share": found.share, "color": found.color}, default=vars))
    print(json.dumps({"halves of the film": compared(second, first.places)}))
    made = against_film(lifted, found, second, given.frames, given.potentials)
    print(json.dumps({"as lifted": made}), flush=True)
    scene = scene_of(asset, given.asset, request, config, footage=None, start=0)
    if scene.whitewater > 0:
        amount, everywhere = scene.whitewater, scene.whitewater_everywhere
        made = of_scene(scene, lambda settled: found.law(lifted, amount, everywhere, settled=settled), given.frames)
        print(json.dumps({"with scene.yaml": made}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
