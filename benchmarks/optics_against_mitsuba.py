"""Refraction and absorption of the quick liquids against path tracing by Mitsuba: a slab and a ball of water.

    python benchmarks/optics_against_mitsuba.py
    python benchmarks/optics_against_mitsuba.py --page docs/looks.md --pictures pictures

The bodies stand before a luminous board. Once it carries two ramps: the ratio of the channels tells, in any picture,
from which place of the board the light of a pixel came, and the third one how much of it is left. Once it carries a
checkerboard, in grey surroundings that mirror in the surface, with an absorption that colours. `mesh` is the
screen-space picture of the exact mesh, `splats` that of Gaussians which fill it, without a mesh, `none` the picture
without refraction (light goes straight, and is absorbed by the true thickness).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from fluidlift.backends.mitsuba_renderer import MitsubaRenderer
from fluidlift.backends.mitsuba_scene import FinalScene, described
from fluidlift.look.environment import Environment
from fluidlift.look.liquid import Behind, SurfaceBuffer, shaded
from fluidlift.look.materials import Material
from fluidlift.look.screen_space import mesh_surface
from fluidlift.look.transparent import splat_surface
from fluidlift.numerics.solid_mesh import box_mesh, ellipsoid_mesh
from fluidlift.types import Gaussians, PinholeCamera, TriangleMesh

BEGIN, END = "<!-- optics:begin -->", "<!-- optics:end -->"
SPACING = 0.02
"""m, of the Gaussians: a thirtieth of the bodies, as in a simulation"""
BOARD = (1.0, 0.75)
"""m, half width and height"""
BOARD_AT = 0.6
"""m behind the middle of the bodies"""
SQUARES = 16
"""across the board"""
AROUND = 0.3
"""radiance of the surroundings of the checkerboard"""
PLAIN = Material("plain", 1.333, absorption=(2.0, 2.0, 2.0))
"""for the ramps: the ratio of channels must not change on the way"""
TINTED = Material("tinted", 1.333, absorption=(0.5, 2.0, 5.0))


@dataclass(frozen=True)
class Body:
    """One shape, as a mesh and as Gaussians."""

    name: str
    mesh: TriangleMesh
    gaussians: Gaussians
    normals: np.ndarray


def slab() -> Body:
    """0.9 x 0.3 x 0.7 m, turned by 30 degrees: the picture behind it is moved aside."""
    size, angle = np.array([0.9, 0.3, 0.7]), np.radians(30.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    mesh = box_mesh(size)
    flat = np.asarray(mesh.faces)
    # corners of their own for each face: the normals of a box jump at its edges
    mesh = TriangleMesh(np.asarray(mesh.vertices)[flat.ravel()] @ turn.T, np.arange(flat.size).reshape(-1, 3))
    inside = _lattice(size)
    gap = 0.5 * size - np.abs(inside)
    normals = np.zeros_like(inside)
    near = gap.argmin(axis=1)
    normals[np.arange(len(inside)), near] = np.sign(inside[np.arange(len(inside)), near])
    normals *= (gap.min(axis=1) < 2 * SPACING)[:, None]
    return Body("slab", mesh, _filled(inside @ turn.T), normals @ turn.T)


def ball() -> Body:
    """0.3 m of radius: a lens that turns the picture upside down."""
    inside = _lattice(np.full(3, 0.6))
    inside = inside[np.linalg.norm(inside, axis=1) < 0.3]
    return Body("ball", ellipsoid_mesh((0.3, 0.3, 0.3)), _filled(inside), inside / 0.3)


def _lattice(size: np.ndarray) -> np.ndarray:
    counts = np.round(size / SPACING).astype(int)
    axes = [(np.arange(n) + 0.5) / n * s - s / 2 for n, s in zip(counts, size)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return points + np.random.default_rng(0).uniform(-0.2, 0.2, points.shape) * SPACING


def _filled(points: np.ndarray) -> Gaussians:
    return Gaussians.isotropic(points, 0.5 * SPACING, np.full((len(points), 3), 0.5), 0.8)


def watching(width: int) -> PinholeCamera:
    """A camera 2.5 m in front of the bodies that sees them before the board."""
    return PinholeCamera.looking(np.array([0.0, -2.5, 0.0]), np.zeros(3), 36.0, (width, width * 3 // 4))


def pattern(kind: str) -> np.ndarray:
    """float32 [h,w,3] of the board, first row up: "ramps" or "squares"."""
    rows, columns = 384, 512
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    if kind == "ramps":
        return np.stack([u, v, np.ones_like(u)], -1).astype(np.float32)
    dark = (np.floor(u * SQUARES) + np.floor(v * SQUARES * rows / columns)) % 2
    return np.repeat(0.1 + 0.8 * dark[..., None], 3, axis=2).astype(np.float32)


def behind(camera: PinholeCamera, kind: str, around: float, fine: int = 4) -> Behind:
    """The board alone, as this camera sees it (mean of fine x fine rays a pixel)."""
    w, h = camera.size
    rays = camera.resized((w * fine, h * fine))
    rays = rays.rays(rays.pixel_grid())
    eye = camera.position
    at = eye + rays * ((BOARD_AT - eye[1]) / rays[..., 1])[..., None]
    board = pattern(kind)
    x = (at[..., 0] / BOARD[0] * 0.5 + 0.5) * board.shape[1] - 0.5
    y = (0.5 - at[..., 2] / BOARD[1] * 0.5) * board.shape[0] - 0.5
    seen = np.stack([ndimage.map_coordinates(board[..., k], [y, x], order=1, mode="nearest") for k in range(3)], -1)
    on = (np.abs(at[..., 0]) < BOARD[0]) & (np.abs(at[..., 2]) < BOARD[1])
    seen = np.where(on[..., None], seen, around).reshape(h, fine, w, fine, 3).mean(axis=(1, 3))
    depth = np.where(on.reshape(h, fine, w, fine).mean(axis=(1, 3)) > 0.5, BOARD_AT - eye[1], 0.0)
    return Behind(seen, depth)


def traced(body: Body, camera: PinholeCamera, kind: str, material: Material, around: float, samples: int) -> np.ndarray:
    """Mitsuba's picture: linear [h,w,3]."""
    mi: Any = MitsubaRenderer("scalar_rgb")._mi
    mi.set_variant("scalar_rgb")
    environment = np.full((4, 8, 3), around, np.float32)
    scene = FinalScene(body.mesh, material, camera, environment, softness=0.0)
    parts = described(mi, scene, camera)
    place = np.eye(4)
    place[:3, :3] = np.stack([[BOARD[0], 0, 0], [0, 0, BOARD[1]], [0, -1.0, 0]], axis=1)
    place[:3, 3] = (0.0, BOARD_AT, 0.0)
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(pattern(kind)[::-1])), "raw": True}
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    light = {"type": "area", "radiance": picture}
    parts["board"] = {"type": "rectangle", "to_world": mi.ScalarTransform4f(place), "bsdf": black, "emitter": light}
    return np.asarray(mi.render(mi.load_dict(parts), spp=samples, seed=1))[..., :3]


def surfaces(body: Body, camera: PinholeCamera) -> dict[str, SurfaceBuffer]:
    """The body as both quick ways see it."""
    splats = splat_surface(body.gaussians, body.normals, camera, volume=SPACING**3)
    return {"mesh": mesh_surface(body.mesh, camera), "splats": splats}


def straight(exact: SurfaceBuffer, scene: Behind, material: Material) -> np.ndarray:
    """The picture without refraction and mirror."""
    return scene.image * np.exp(-exact.thickness[..., None] * np.asarray(material.absorption))


def silhouette(exact: SurfaceBuffer, pixels: int = 2) -> np.ndarray:
    """bool [h,w]: inside the outline by some pixels."""
    return ndimage.binary_erosion(exact.covered > 0.99, iterations=pixels)


def origins(picture: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """float [h,w,2], px: where the light of each pixel lay in the picture of the board alone; NaN of little light."""
    left = picture[..., 2:]
    share = picture[..., :2] / np.where(left > 0.05, left, np.nan)
    x, z = (2 * share[..., 0] - 1) * BOARD[0], (1 - 2 * share[..., 1]) * BOARD[1]
    return camera.project(np.stack([x, np.full_like(x, BOARD_AT), z], -1))[0]


def compared(body: Body, width: int, samples: int) -> tuple[dict[str, dict[str, float]], dict[str, np.ndarray]]:
    """Figures per way of drawing, and the pictures of the checkerboard.

    Figures: `difference`, mean absolute difference of linear light; `bent`, median distance (px) between the places
    of the board that are seen; `bent_95`, its 95th percentile; `light`, ratio of the transmitted light; `seconds`.
    """
    camera = watching(width)
    ramps, squares = behind(camera, "ramps", 0.0), behind(camera, "squares", AROUND)
    true_ramps = traced(body, camera, "ramps", PLAIN, 0.0, samples)
    true_squares = traced(body, camera, "squares", TINTED, AROUND, samples)
    ways = surfaces(body, camera)
    inside = silhouette(ways["mesh"])
    true_place, place0 = origins(true_ramps, camera), origins(ramps.image, camera)
    # of a pixel with light from several places the mean would be compared: those within 2 % of the board's rim, and
    # the rim of total reflection, are left out
    firm = inside & np.isfinite(true_place).all(-1) & (ndimage.minimum_filter(true_ramps[..., 2], 3) > 0.2)
    figures: dict[str, dict[str, float]] = {}
    pictures = {"mitsuba": true_squares}
    for name in ("mesh", "splats", "none"):
        began = time.perf_counter()
        if name == "none":
            mine = straight(ways["mesh"], ramps, PLAIN), straight(ways["mesh"], squares, TINTED)
        else:
            mine = (shaded(ways[name], ramps, camera, PLAIN, Environment.white(0.0)),
                    shaded(ways[name], squares, camera, TINTED, Environment.white(AROUND)))  # fmt: skip
        pictures[name] = mine[1]
        both = firm & (mine[0][..., 2] > 0.05)
        off = np.linalg.norm(origins(mine[0], camera) - true_place, axis=-1)[both]
        figures[name] = {
            "difference": float(np.abs(mine[1] - true_squares)[inside].mean()),
            "bent": float(np.median(off)), "bent_95": float(np.percentile(off, 95)),
            "light": float(mine[0][inside][:, 2].sum() / true_ramps[inside][:, 2].sum()),
            "seconds": time.perf_counter() - began,
        }  # fmt: skip
    moved = np.linalg.norm(true_place - place0, axis=-1)[firm]
    figures["mitsuba"] = {"moved": float(np.median(moved)), "firm": float(firm.sum() / inside.sum())}
    return figures, pictures


def page_section(found: dict[str, dict[str, dict[str, float]]], width: int, samples: int) -> str:
    """The table."""
    from report import table

    rows = []
    for body, ways in found.items():
        for name in ("mesh", "splats", "none"):
            f = ways[name]
            rows.append([body, name, f"{f['difference']:.3f}", f"{f['bent']:.2f}", f"{f['bent_95']:.2f}",
                         f"{ways['mitsuba']['moved']:.1f}", f"{f['light']:.3f}"])  # fmt: skip
    head = [
        "body",
        "drawn from",
        "difference of light",
        "pattern off by, px",
        "95 %, px",
        "moved by, px",
        "light, ratio",
    ]
    told = (
        f"Pictures of {width} px, {samples} light paths a pixel; board of radiance 0.1 and 0.9, surroundings {AROUND}."
    )
    return "\n".join([told, "", *table(head, rows)]).rstrip() + "\n"


def main() -> None:
    """Measure, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=240, help="px")
    parser.add_argument("--samples", type=int, default=256, help="light paths per pixel")
    parser.add_argument("--page", type=Path, help=f"page with the markers {BEGIN} and {END}")
    parser.add_argument(
        "--pictures", type=Path, help="folder for the pictures side by side: Mitsuba, mesh, splats, none"
    )
    a = parser.parse_args()
    found = {}
    for body in (slab(), ball()):
        found[body.name], pictures = compared(body, a.width, a.samples)
        if a.pictures is not None:
            from PIL import Image

            from fluidlift.numerics.srgb import srgb_from_linear

            a.pictures.mkdir(parents=True, exist_ok=True)
            row = np.concatenate([pictures[k] for k in ("mitsuba", "mesh", "splats", "none")], axis=1)
            Image.fromarray((255 * srgb_from_linear(row) + 0.5).astype(np.uint8)).save(a.pictures / f"{body.name}.png")
    text = page_section(found, a.width, a.samples)
    print(text)
    if a.page is not None:
        from page_section import replace_section

        replace_section(a.page, text, BEGIN, END)


if __name__ == "__main__":
    main()
