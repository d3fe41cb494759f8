"""Pictures of whole assets: the teaser, input beside re-simulation, the examples, the edits, per-frame bodies."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
from benchmarks.paper import scenes
from benchmarks.paper.tiles import Tile, fit, sheet
from benchmarks.paper.workshop import FIRST, ROOT, Workshop, frames_of, read_picture

from fluidlift.evaluate.images import mask_iou, psnr
from fluidlift.io.asset_folder import load_asset
from fluidlift.look.rasterize import render
from fluidlift.pipeline import resimulate
from fluidlift.scene import EditSession
from fluidlift.scene.edits import Add, Set
from fluidlift.scene.splat_files import frame_file, read_frame
from fluidlift.shape.generate import bounded_colours, front_gaussians
from fluidlift.shape.refine import refine

WATER = {"look": "surface", "material": "water"}
"""how a surface is drawn as clear water"""
SHOWN = 14
"""frame of an asset that pictures show, counted from 0"""


def _input(shop: Workshop, asset: Path, frame: int) -> np.ndarray:
    """A frame of the clip as the pipeline read it, counted from the asset's first."""
    read, geometry = shop.stage(asset, "read"), shop.stage(asset, "geometry")
    return np.asarray(read.clip.frames[min(geometry.rest_frame + frame, len(read.clip) - 1)])


def _size(asset: Path, width: int = 640) -> tuple[int, int]:
    w, h = load_asset(asset).camera.size
    return width, 2 * round(0.5 * width * h / w)


def edited(shop: Workshop) -> Path:
    """The demo with a boulder, a pillar and 0.8 m more of its bed."""
    source, folder = shop.asset("demo"), shop.folder / "demo_edited.fluid"
    if not (folder / "edited.done").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(source, folder)
        asset = load_asset(source)
        along = asset.terrain.mainstream / np.linalg.norm(asset.terrain.mainstream)
        across = np.cross([0.0, 0.0, 1.0], along)
        middle, deep = np.median(asset.rest.means, axis=0), float(np.ptp(asset.rest.means[:, 2]))
        end = middle + float(((asset.rest.means - middle) @ along).max()) * along
        rock, pillar = end - 1.8 * deep * along - 0.8 * deep * across, end + 0.32 * along + 0.5 * deep * across
        EditSession.open(folder).apply([
            Set("extend_downstream", 0.8),
            Add("obstacles", {"name": "rock", "shape": "ellipsoid", "color": [0.5, 0.45, 0.4],
                              "size": _round([1.6 * deep, 1.3 * deep, 1.6 * deep]), "position": _round(rock)}),
            Add("obstacles", {"name": "pillar", "shape": "cylinder", "radius": round(0.4 * deep, 3),
                              "height": round(3 * deep, 3), "position": _round(pillar), "color": [0.75, 0.35, 0.2]}),
        ])  # fmt: skip
        resimulate(folder, overrides=["show.usd=false", "show.preview=false"])
        (folder / "edited.done").touch()
    return folder


def _round(values) -> list[float]:
    return [round(float(v), 3) for v in values]


def teaser(shop: Workshop) -> None:
    """Fig. teaser: the clip, the asset from the side, edited, and the edited one drawn as water."""
    asset, changed = shop.asset("demo"), edited(shop)
    size, last = _size(asset), FIRST + frames_of(changed) - 1
    tiles = [
        Tile("(a) the clip", _input(shop, asset, SHOWN)),
        Tile("(b) the asset, from the side", shop.drawn(asset, FIRST + SHOWN, size, view="side")),
        Tile("(c) edited: a boulder, a pillar, 0.8 m more", shop.drawn(changed, last, size, view="side")),
        Tile("(d) the same, drawn as water", shop.drawn(changed, last, size, view="side", **WATER)),
    ]  # fmt: skip
    shop.keep("teaser.jpg", sheet(tiles, 2, 480))


def resimulated(shop: Workshop) -> None:
    """Fig. raw: input, re-simulation with the clip's colours, and the same surface rendered."""
    asset = shop.asset("demo")
    size, number = _size(asset), FIRST + SHOWN
    tiles = [
        Tile("the clip", _input(shop, asset, SHOWN)),
        Tile("re-simulated", shop.drawn(asset, number, size, view="input", background="auto")),
        Tile("rendered", shop.drawn(asset, number, size, view="input", look="surface", material="water")),
    ]
    shop.keep("resimulated.jpg", sheet(tiles, 3, 320))


def examples(shop: Workshop) -> None:
    """Fig. all: eight made scenes, each as filmed, re-simulated in the same view, and from the side."""
    rows = []
    for name in scenes.EXAMPLES:
        asset = shop.asset(name)
        frame = min(SHOWN, frames_of(asset) - 1)
        size, number = _size(asset, 480), FIRST + frame
        filmed = _input(shop, asset, frame)
        again = shop.drawn(asset, number, size, view="input", background="auto")
        beside = shop.drawn(asset, number, size, view="side")
        _like(shop, name, asset, frame)
        pictures = [_boxed(p) for p in (filmed, again, beside)]
        rows += [Tile(f"{name}: {scenes.PLANS[name].title}", pictures[0]), Tile("", pictures[1]), Tile("", pictures[2])]
    shop.tell("examples", "made", len(rows) // 3)
    shop.keep("examples.jpg", sheet(rows, 3, 300))


def _boxed(picture: np.ndarray, shape: float = 0.68) -> np.ndarray:
    """The middle of a picture, cut to one height over width, so that rows are alike."""
    h, w = picture.shape[:2]
    high = min(h, round(shape * w))
    wide = min(w, round(high / shape))
    y, x = (h - high) // 2, (w - wide) // 2
    return picture[y : y + high, x : x + wide]


def _like(shop: Workshop, name: str, asset: Path, frame: int) -> None:
    """How like its clip the re-simulation is, in the mask, over the frames up to the one shown."""
    body, labels = load_asset(asset), shop.stage(asset, "segment").labels
    read, start = shop.stage(asset, "read"), shop.stage(asset, "geometry").rest_frame
    plate = shop.stage(asset, "geometry").plate.astype(np.float32) / 255
    likeness, overlap = [], []
    for k in range(0, frame + 1, 4):
        t = min(start + k, len(read.clip) - 1)
        drawn = render(read_frame(frame_file(asset, FIRST + k)).gaussians, body.camera, background=plate)
        shown = (255 * np.clip(drawn.image, 0, 1) + 0.5).astype(np.uint8)
        likeness.append(psnr(shown, np.asarray(read.clip.frames[t]), labels.fluid[t]))
        overlap.append(float(mask_iou((drawn.alpha > 0.5)[None], labels.fluid[t][None])[0]))
    shop.tell(f"example: {name}", "PSNR in the mask", float(np.mean(likeness)), "dB", "more")
    shop.tell(f"example: {name}", "IoU of the mask", float(np.mean(overlap)), "", "more")


def edits(shop: Workshop) -> None:
    """Fig. editing: pictures of the scripts in benchmarks/edits, as they lie in the documentation."""
    folder = ROOT / "docs" / "pictures"
    named = {
        "edit_01_longer_river": "(a) objects, a longer bed", "edit_02_turned": "(b) gravity turned, lava",
        "edit_03_twisted": "(c) twisted ground, texture, dye", "edit_04_honey": "as honey",
        "edit_05_after": "after two minutes", "edit_06_duck": "a duck afloat",
    }  # fmt: skip
    tiles = []
    for name, text in named.items():
        picture = read_picture(folder / f"{name}.jpg")
        if picture.shape[1] > 2.5 * picture.shape[0]:  # two pictures side by side: the first
            picture = picture[:, : picture.shape[1] // 2]
        tiles.append(Tile(text, _boxed(picture, 0.6)))
    shop.keep("edits.jpg", sheet(tiles, 3, 320))


def per_frame(shop: Workshop) -> None:
    """What stands in for the user study: a body of each frame by itself, as a generator gives it, against ours.

    Both are drawn in the clip's view and from the side: likeness to the clip, flicker (mean second difference in time),
    crispness (mean gradient over the clip's).
    """
    asset = shop.asset("demo")
    body, read, geometry = load_asset(asset), shop.stage(asset, "read"), shop.stage(asset, "geometry")
    labels, start, camera = shop.stage(asset, "segment").labels, geometry.rest_frame, geometry.camera
    from fluidlift.look.scenery import orbit_camera

    beside = orbit_camera(camera, body.rest.means)
    kinds: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {"each frame by itself": [], "ours": []}
    clips, masks = [], []
    for k in range(SHOWN - 6, SHOWN):
        t = start + k
        clips.append(np.asarray(read.clip.frames[t]))
        masks.append(labels.fluid[t] & (geometry.depth > 0))
        given = front_gaussians(clips[-1], masks[-1], geometry.depth, camera, stride=2)
        found = refine(given, clips[-1], masks[-1], camera, iterations=30, seed=t)
        single = bounded_colours(found.gaussians, clips[-1], camera)
        simulated = read_frame(frame_file(asset, FIRST + k)).gaussians
        for name, one in (("each frame by itself", single), ("ours", simulated)):
            front, side = (_bytes(render(one, c, background=(1.0, 1.0, 1.0)).image) for c in (camera, beside))
            kinds[name].append((front, side))
    steady = np.logical_and.reduce(masks)
    filmed = _flicker(clips, steady), _crisp(clips, steady)
    shop.tell("the clip", "flicker", filmed[0], "levels of 255")
    shop.tell("the clip", "crispness", filmed[1], "levels of 255 per px")
    for name, pictures in kinds.items():
        front, side = [p[0] for p in pictures], [p[1] for p in pictures]
        seen = np.logical_and.reduce([(p < 250).any(axis=-1) for p in side])
        likeness = np.mean([psnr(a, b, m) for a, b, m in zip(front, clips, masks, strict=True)])
        shop.tell(name, "PSNR", float(likeness), "dB", "more")
        shop.tell(name, "flicker", _flicker(front, steady), "levels of 255")
        shop.tell(name, "flicker from the side", _flicker(side, seen), "levels of 255")
        shop.tell(name, "crispness", _crisp(front, steady), "levels of 255 per px")
        shop.tell(name, "seen from the side", float(seen.mean()), "of the picture", "more")
    tiles = [Tile("the clip", clips[-1])]
    tiles += [Tile(f"{name}, {where}", fit(p[-1][i], 640)) for i, where in enumerate(("clip's view", "side"))
              for name, p in kinds.items()]  # fmt: skip
    shop.keep("per_frame.jpg", sheet([tiles[0], tiles[1], tiles[2], tiles[3], tiles[4]], 3, 320))


def _bytes(image: np.ndarray) -> np.ndarray:
    return (255 * np.clip(image, 0, 1) + 0.5).astype(np.uint8)


def _flicker(pictures: list[np.ndarray], where: np.ndarray) -> float:
    a = np.stack([p[where] for p in pictures]).astype(np.float32)
    return float(np.abs(a[:-2] - 2 * a[1:-1] + a[2:]).mean())


def _crisp(pictures: list[np.ndarray], where: np.ndarray) -> float:
    inner = cv2.erode(where.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return float(np.mean([np.hypot(*np.gradient(p.mean(axis=-1)))[inner].mean() for p in pictures]))
