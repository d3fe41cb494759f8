"""Makes cases with a known truth in Blender: Mantaflow moves the fluid, Cycles draws it.

    python benchmarks/blender_cases.py --work cases --only dam_pillar smoke

Neither is of this project, so what is measured on these cases is not flattered by a simulator or a renderer that it
shares with them. Needs the program `blender` (3.x, with numpy in its Python) and minutes per case. A folder as
`fluidlift evaluate --truth` reads it comes out for each: video.mp4, camera.json, scene.json, truth.npz, solids.npz.

Three steps: Blender bakes (and, a gas, draws); what the pictures need is worked out here (colours that the liquid
carries along, motion of each pixel); Blender draws liquids and looks with rays for their depth. At 25 frames per second
Mantaflow's clock is that of the world; it keeps a wall a cell thick inside its domain. Motion in the picture is that of
the grid's velocity, averaged over both frames: good to the change of the velocity within a frame.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from blender_beds import STREAMS, Carried, bed_mesh, rock_mesh

FPS, SOLVER_TIME = 25, 0.1
"""pictures per second; Mantaflow's time in one of them"""
EXTINCTION = 8.0
"""of the smoke in the pictures, per metre and unit of density"""
INSIDE = Path(__file__).with_name("blender_inside.py")
Spec = dict[str, Any]

DAM = {"kind": "liquid", "size": [320, 240], "frames": 44, "spacing": 0.025, "hold": 0, "walls": 0.0}
CASES: dict[str, Spec] = {
    # low and high are those of the basin, inside its walls
    "dam_pillar": DAM | {
        "low": [-1.0, -0.5, 0.0], "high": [1.0, 0.5, 0.9], "body": [[0.3, -0.5, 0.0], [1.0, 0.5, 0.5]],
        "pillars": [[[-0.42, 0.04, 0.0], [-0.27, 0.19, 0.7]]], "eye": [0.9, -2.6, 1.5], "target": [-0.05, 0.0, 0.15],
        "fov": 46.0,
    },
    "dam_middle": DAM | {
        "low": [-0.8, -0.8, 0.0], "high": [0.8, 0.8, 0.9], "body": [[-0.3, -0.25, 0.0], [0.3, 0.25, 0.55]],
        "pillars": [], "eye": [-0.8, -2.3, 2.0], "target": [0.0, 0.0, 0.05], "fov": 48.0, "walls": 0.15,
    },
    "dam_towards": DAM | {
        "low": [-0.6, -1.0, 0.0], "high": [0.6, 0.9, 0.9], "body": [[-0.6, 0.4, 0.0], [0.6, 0.9, 0.65]],
        "pillars": [], "eye": [0.5, -3.0, 1.6], "target": [0.0, -0.1, 0.15], "fov": 44.0,
    },
    "smoke": {
        "kind": "gas", "size": [224, 304], "frames": 50, "first": 50, "spacing": 0.04, "low": [-0.8, -0.8, 0.0],
        "high": [0.8, 0.8, 3.2], "source": [[0.0, 0.0, 0.12], 0.18, 0.08], "jet": [0.0, 0.0, 0.8], "heat": 0.5,
        "eye": [-0.9, -6.4, 1.5], "target": [0.0, 0.0, 1.5], "fov": 24.0,
    },
    **STREAMS,
}  # fmt: skip


def camera_of(spec: Spec) -> Spec:
    """The contents of camera.json: OpenCV axes, x_cam = R x_world + t, pixel centres at +0.5."""
    eye, (w, h) = np.array(spec["eye"], float), spec["size"]
    forward = np.array(spec["target"], float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    f = 0.5 * w / math.tan(math.radians(spec["fov"]) / 2)
    K = [[f, 0.0, w / 2], [0.0, f, h / 2], [0.0, 0.0, 1.0]]
    return {"width": w, "height": h, "K": K, "R": rotation.tolist(), "t": (-rotation @ eye).tolist()}


def grid_of(spec: Spec) -> tuple[np.ndarray, np.ndarray]:
    """Low corner and number of cells of the solver's domain: a cell of wall more on each side."""
    h, low, high = spec["spacing"], np.array(spec["low"]), np.array(spec["high"])
    return low - h, np.round((high - low) / h).astype(int) + 2


def viscosity_of(spec: Spec) -> float:
    """Kinematic, m^2/s: Mantaflow's is in squares of the domain's longest side and in its own unit of time."""
    longest = spec["spacing"] * int(grid_of(spec)[1].max())
    return spec.get("viscosity", 0.0) * longest**2 * SOLVER_TIME * FPS


def box_mesh(low: list[float], high: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles, seen from outside."""
    v = np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]]
                  for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.float32)  # fmt: skip
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return v, np.array([t for q in quads for t in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))], np.int32)


def solids_of(spec: Spec) -> dict[str, tuple[np.ndarray, np.ndarray, list[float]]]:
    """Meshes and colours of all that stands still."""
    low, high, wall = spec["low"], spec["high"], spec.get("walls", 0.0)
    reach = 2.0 * max(high[0] - low[0], high[1] - low[1])
    if "bed" in spec:
        out = {"bed": (*bed_mesh(spec), [0.36, 0.28, 0.2])}
        out |= {f"pillar{k}": (*box_mesh(a, b), [0.4, 0.4, 0.4]) for k, (a, b) in enumerate(spec.get("pillars", []))}
        return out | {f"rock{k}": (*rock_mesh(spec, r), [0.4, 0.38, 0.36]) for k, r in enumerate(spec.get("rocks", []))}
    out = {"floor": (*box_mesh([low[0] - reach, low[1] - reach, -0.1], [high[0] + reach, high[1] + reach, 0.0]),
                     [0.42, 0.36, 0.30])}  # fmt: skip
    for k, (a, b) in enumerate(spec.get("pillars", [])):
        out[f"pillar{k}"] = (*box_mesh(a, b), [0.55, 0.25, 0.18])
    if wall:
        t = 0.04
        sides = [([low[0] - t, low[1] - t], [low[0], high[1] + t]), ([high[0], low[1] - t], [high[0] + t, high[1] + t]),
                 ([low[0], low[1] - t], [high[0], low[1]]), ([low[0], high[1]], [high[0], high[1] + t])]  # fmt: skip
        for k, (a, b) in enumerate(sides):
            out[f"wall{k}"] = (*box_mesh([*a, 0.0], [*b, wall]), [0.5, 0.5, 0.52])
    return out


def in_blender(step: str, name: str, folder: Path) -> None:
    """Runs a step of this file in Blender."""
    program = os.environ.get("BLENDER", "blender")
    command = [program, "-b", "--factory-startup", "-t", "2", "--python-exit-code", "1", "-P"]
    with (folder / f"{step}.log").open("w") as log:
        subprocess.run(
            [*command, str(INSIDE), "--", step, name, str(folder)], check=True, stdout=log, stderr=subprocess.STDOUT
        )


def key_frames(spec: Spec) -> list[int]:
    """Of those that are simulated, without the ones in which the body is held."""
    last = spec["frames"] - spec.get("hold", 0) - 1
    return [0, last // 4, last // 2, last]


def states_of(folder: Path) -> list[Path]:
    """One file per frame."""
    return sorted((folder / "states").glob("*.npz"))


def filled(velocity: np.ndarray) -> np.ndarray:
    """Where there is no fluid, the velocity of the nearest cell that has some."""
    from scipy import ndimage

    at = ndimage.distance_transform_edt(~velocity.any(axis=-1), return_distances=False, return_indices=True)
    return velocity[tuple(at)]


def moved(points: np.ndarray, before: np.ndarray, after: np.ndarray, spec: Spec) -> np.ndarray:
    """Points a frame later: the midpoint rule with the mean of both frames' velocities."""
    from scipy import ndimage

    low, _ = grid_of(spec)
    mean = 0.5 * (before + after)

    def speed(x: np.ndarray) -> np.ndarray:
        at = ((x - low) / spec["spacing"] - 0.5).T
        return np.stack([ndimage.map_coordinates(mean[..., a], at, order=1, mode="nearest") for a in range(3)], -1)

    return points + speed(points + 0.5 / FPS * speed(points)) / FPS


def poured(spec: Spec) -> tuple[np.ndarray, np.ndarray]:
    """Many points in the body of liquid that is there at first, and a shade each, 0 to 1."""
    from scipy.spatial import cKDTree

    generator, h = np.random.default_rng(3), spec["spacing"]
    low, high = (np.array(x) for x in spec["body"])
    count = int(np.prod(high - low) / (0.7 * h) ** 3)
    points = generator.uniform(low, high, (count, 3))
    # fine grain on patches: the patches are still told apart where the grain is smaller than a pixel
    patches = cKDTree(generator.uniform(low, high, (max(count // 150, 8), 3)))
    shades = 0.55 * generator.uniform(size=count) + 0.45 * generator.uniform(size=patches.n)[patches.query(points)[1]]
    return points, shades


def color(spec: Spec, folder: Path) -> None:
    """Colours of the surface's vertices: of the nearest of many points that go along with the liquid."""
    from scipy.spatial import cKDTree

    h, before, carried = spec["spacing"], None, None
    points, shades = poured(spec) if "body" in spec else (np.empty((0, 3)), np.empty(0))
    for path in states_of(folder):
        with np.load(path) as state:
            vertices, inside = state["v"], state["velocity"]
        velocity = filled(inside)
        if before is not None:
            points = moved(points, before, velocity, spec)
        before = velocity
        if "inflow" in spec:
            if carried is None:
                carried = Carried(spec, grid_of(spec)[0], inside)
            else:
                carried.step(points, inside)
            points, shades = carried.points, carried.shades
        dark, light = np.array(spec.get("colors", [[0.02, 0.10, 0.22], [0.45, 0.75, 0.85]]))
        colors = dark + shades[:, None] * (light - dark)
        away, near = cKDTree(points).query(vertices, k=4, workers=1)
        weight = 1.0 / (away + 0.1 * h) ** 2
        found = (weight[..., None] * colors[near]).sum(axis=1) / weight.sum(axis=1)[:, None]
        np.save(folder / "colors" / f"{path.stem}.npy", np.c_[found, np.ones(len(found))].astype(np.float32))


def liquid_truth(spec: Spec, folder: Path) -> Spec:
    """Arrays of truth.npz from what Blender's rays saw."""
    seen, (w, h) = camera_of(spec), spec["size"]
    states, keys = states_of(folder), key_frames(spec)
    depth, flow, change = (np.zeros((len(states), h, w, *more), np.float32) for more in ((), (2,), ()))
    mask, phi, speed, before, ground = np.zeros(depth.shape, bool), [], [], None, depth[0]
    for t, path in enumerate(states):
        with np.load(folder / "seen" / path.name) as rays:
            ground, near = rays["ground"], rays["depth"]
            phi += [rays["phi"]] if t in keys else []
        with np.load(path) as state:
            velocity = state["velocity"]
        speed += [velocity] if t in keys else []
        velocity = filled(velocity)
        mask[t] = np.isfinite(near) & (near < ground)
        depth[t][mask[t]] = near[mask[t]]
        if before is not None:
            flow[t - 1], change[t - 1] = seen_motion(depth[t - 1], mask[t - 1], before, velocity, spec, seen)
        before = velocity
    assert before is not None
    flow[-1], change[-1] = seen_motion(depth[-1], mask[-1], before, before, spec, seen)
    ground = np.where(np.isfinite(ground), ground, 0.0)
    return {"depth": depth, "flow": flow, "dz": change, "mask": mask, "static_depth": ground, "grid_phi": np.stack(phi),
            "grid_velocity": np.stack(speed)}  # fmt: skip


def seen_motion(depth, mask, before, after, spec: Spec, seen: Spec) -> tuple[np.ndarray, np.ndarray]:
    """Planar motion, px, and change of depth, m, of the points seen at the pixels of a mask."""
    f, R, t = seen["K"][0][0], np.array(seen["R"]), np.array(seen["t"])
    (h, w), flow, change = mask.shape, np.zeros((*mask.shape, 2), np.float32), np.zeros(mask.shape, np.float32)
    i, j = np.nonzero(mask)
    z = depth[mask].astype(float)
    points = (np.c_[(j + 0.5 - w / 2) / f * z, (i + 0.5 - h / 2) / f * z, z] - t) @ R
    later = moved(points, before, after, spec) @ R.T + t
    flow[mask] = np.c_[f * later[:, 0] / later[:, 2] + w / 2 - j - 0.5, f * later[:, 1] / later[:, 2] + h / 2 - i - 0.5]
    change[mask] = later[:, 2] - z
    return flow, change


def gas_truth(spec: Spec, folder: Path) -> Spec:
    """Arrays of truth.npz: means along each ray, each point weighted by what the eye gets of it."""
    from scipy import ndimage

    seen, (w, h), (low, _) = camera_of(spec), spec["size"], grid_of(spec)
    f, R, eye = seen["K"][0][0], np.array(seen["R"]), np.array(spec["eye"])
    u, v = np.meshgrid((np.arange(w) + 0.5 - w / 2) / f, (np.arange(h) + 0.5 - h / 2) / f)
    rays = np.stack([u, v, np.ones_like(u)], -1)
    away = float(R[2] @ (0.5 * (np.array(spec["low"]) + spec["high"]) - eye))
    half = 0.5 * float(np.linalg.norm(np.array(spec["high"][:2]) - spec["low"][:2]))
    step = 0.75 * spec["spacing"]
    z = np.arange(away - half, away + half, step)
    points = eye + (rays[:, :, None] * z[:, None]) @ R
    at = np.moveaxis((points - low) / spec["spacing"] - 0.5, -1, 0)
    length, out, keys = step * np.linalg.norm(rays, axis=-1), [], key_frames(spec)
    grids, speeds = [], []
    for t, path in enumerate(states_of(folder)):
        with np.load(path) as state:
            density, velocity = state["density"], state["velocity"]
        if t in keys:
            grids, speeds = [*grids, density], [*speeds, velocity]
        thick = EXTINCTION * length[..., None] * ndimage.map_coordinates(density, at, order=1)
        weight = np.exp(-np.cumsum(thick, axis=-1)) * np.expm1(thick)
        opacity = 1.0 - np.exp(-thick.sum(axis=-1))
        total, used = np.maximum(weight.sum(axis=-1), 1e-9), weight > 1e-4
        depth = (weight * z).sum(axis=-1) / total
        moving = np.zeros((*weight.shape, 3), np.float32)
        moving[used] = np.stack([ndimage.map_coordinates(velocity[..., a], at[:, used], order=1) for a in range(3)], -1)
        mean = (weight[..., None] * moving).sum(axis=2) / total[..., None] @ R.T / FPS
        flow = f * (mean[..., :2] - rays[..., :2] * mean[..., 2:]) / np.maximum(depth, 0.1)[..., None]
        mask = opacity > 0.15
        out.append((np.where(mask, depth, 0), np.where(mask[..., None], flow, 0), np.where(mask, mean[..., 2], 0), mask,
                    np.round(255 * opacity).astype(np.uint8)))  # fmt: skip
    depth, flow, change, mask, opacity = (np.stack(x) for x in zip(*out))
    return {
        "depth": depth, "flow": flow, "dz": change, "mask": mask, "opacity": opacity,
        "static_depth": np.zeros((h, w)), "grid_density": np.stack(grids), "grid_velocity": np.stack(speeds),
    }  # fmt: skip


def write_case(name: str, spec: Spec, folder: Path, truth: Spec) -> None:
    """All files of a case. While a body is held, its first frame is shown and nothing moves."""
    from PIL import Image

    from fluidlift.io.encode import write_video

    hold, (low, cells) = spec.get("hold", 0), grid_of(spec)
    pictures = [np.array(Image.open(p).convert("RGB")) for p in sorted((folder / "pictures").glob("*.png"))]
    write_video(folder / "video.mp4", np.stack([pictures[0]] * hold + pictures), FPS)
    (folder / "camera.json").write_text(json.dumps(camera_of(spec), indent=1))
    scene = {
        "case": name, "simulator": "Mantaflow in Blender", "renderer": "Cycles", "fps": FPS, "dt": 1.0 / FPS,
        "gravity": [0.0, 0.0, -9.81], "units": "metres, seconds; world right-handed, +z up",
        "domain_min": low.tolist(), "domain_max": (low + cells * spec["spacing"]).tolist(), "dx": spec["spacing"],
        "grid": cells.tolist(), "viscosity_m2_s": viscosity_of(spec), "video_frames": spec["frames"],
        "inflow": {"velocity_m_s": spec.get("jet", [0.0, 0.0, 0.0])}, "made_from": spec,
    }  # fmt: skip
    (folder / "scene.json").write_text(json.dumps(scene, indent=1))
    arrays = {}
    for key, value in truth.items():
        if hold and not key.startswith(("grid", "static")):
            first = np.repeat(value[:1], hold, axis=0)
            value = np.concatenate([0 * first if key in ("flow", "dz") else first, value])
        arrays[key] = np.packbits(value, axis=-1) if value.dtype == bool else value
        if value.dtype.kind == "f":
            arrays[key] = value.astype(np.float16)
    keys = np.array([k + hold for k in key_frames(spec)], np.int32)
    np.savez_compressed(folder / "truth.npz", key_frames=keys, **arrays)
    parts = {}
    for k, (v, f, rgb) in solids_of(spec).items():
        parts |= {f"{k}_v": v, f"{k}_f": f, f"{k}_rgb": np.array(rgb, np.float32)}
    np.savez_compressed(folder / "solids.npz", **parts)


def make_case(name: str, folder: Path) -> None:
    """Bakes, draws and writes a case; each step's files stay until all is done."""
    spec = CASES[name]
    for part in ("states", "colors", "seen", "pictures"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    if len(states_of(folder)) < spec["frames"] - spec.get("hold", 0):
        in_blender("bake", name, folder)
    if spec["kind"] == "liquid":
        if not any((folder / "seen").iterdir()):
            color(spec, folder)
        in_blender("render", name, folder)
    truth = (liquid_truth if spec["kind"] == "liquid" else gas_truth)(spec, folder)
    write_case(name, spec, folder, truth)
    for part in ("states", "colors", "seen", "pictures", "cache"):
        shutil.rmtree(folder / part, ignore_errors=True)


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for the cases")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES))
    given = parser.parse_args()
    for name in given.only:
        if not (given.work / name / "truth.npz").is_file():
            make_case(name, (given.work / name).resolve())
            print(f"{name}: {given.work / name}", flush=True)


if __name__ == "__main__":
    main()
