"""The stage that shows: preview, report, USD, pictures for measurement."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.look.report import Figure, Section, report_html
from fluidlift.pipeline.body import setting_of
from fluidlift.pipeline.fit_outcome import TIES, how_sure, in_words
from fluidlift.pipeline.moving import targets_of
from fluidlift.pipeline.reading import clip_of
from fluidlift.pipeline.scene import LYING, Footage, Scene
from fluidlift.pipeline.seeing import flow_of, labels_of
from fluidlift.pipeline.simulating import frame_file
from fluidlift.pipeline.story import Result, Story
from fluidlift.types import CellType, Gaussians, PinholeCamera, Similarity3, concatenate, matrix_from_quat


def splat_frames(folder: Path, count: int) -> Iterator[tuple[Gaussians, np.ndarray, np.ndarray]]:
    """(gaussians, ids, velocities) of each simulated frame."""
    from fluidlift.io.ply import read_splats

    for k in range(count):
        splats = read_splats(frame_file(folder, 1001 + k))
        velocity = np.stack([splats.extras[v] for v in ("vx", "vy", "vz")], axis=-1)
        yield splats.gaussians, splats.extras["id"], velocity


def show(
    scene: Scene,
    footage: Footage | None,
    folder: Path,
    config: JobConfig,
    poses: np.ndarray,
    *,
    step: Callable[[int, int], None] = lambda done, total: None,
) -> Result:
    """Render the frames, write what people open.

    Args:
        scene: that was simulated.
        footage: the clip; without it the preview leaves out the input, and the fluid stands before grey.
        folder: of the asset.
        config: its `show` section.
        poses: [k,b,7] of the obstacles in the k frames that were simulated: position (m), orientation (w, x, y, z).
        step: told (frames done, all frames).
    """
    from fluidlift.io.export_usd import write_usd
    from fluidlift.io.frames import MovingMesh
    from fluidlift.io.video import write_video

    count = len(poses)
    measured: dict[str, list[np.ndarray]] = {"frames": [], "mask": [], "flow": []}
    panels = _panels(scene, footage, folder, config, poses, measured, step)
    write_video(folder / "preview.mp4", panels, 1.0 / scene.interval)
    if config.show.usd:
        write_usd(
            folder / "asset.usda",
            frames=splat_frames(folder, count),
            interval=scene.interval,
            terrain=scene.terrain.mesh,
            camera=scene.camera,
            bodies=[
                MovingMesh(o.name, o.mesh, poses[:, b, :3], poses[:, b, 3:]) for b, o in enumerate(scene.obstacles)
            ],
            attributes=scene.parameters.to_dict() | {"kind": scene.kind},
        )
    if not measured["frames"]:
        return Result({}, {"frames": count})
    arrays = {
        "resim_frames": np.stack(measured["frames"]),
        "resim_mask": np.stack(measured["mask"]),
        "resim_flow": np.stack(measured["flow"]).astype(np.float16),
    }
    return Result(arrays, {"frames": count})


def _panels(
    scene: Scene, footage: Footage | None, folder: Path, config: JobConfig, poses: np.ndarray, measured, step
) -> Iterator[np.ndarray]:
    """Input | re-simulation | side view, frame by frame; keeps what the evaluation needs on the way."""
    from fluidlift.look.pictures import caption
    from fluidlift.look.rasterize import render
    from fluidlift.look.scenery import mesh_surfels, side_camera, terrain_depth, terrain_surfels, visible_beside_rocks

    camera, terrain, grid = scene.camera, scene.terrain, scene.terrain.grid
    plate = np.full((camera.size[1], camera.size[0], 3), 0.5, np.float32)
    rocks, compared = np.zeros(plate.shape[:2], bool), 0
    if footage is not None:
        plate = footage.plate.astype(np.float32) / 255.0
        rocks = footage.labels.solid.mean(axis=0) > 0.5
        # frames after the clip, between its own, or with obstacles in them have no counterpart in it
        if scene.interval == scene.clip_interval and not scene.obstacles:
            compared = max(len(footage.clip) - footage.start, 1)
    solid_depth = terrain_depth(terrain, camera) if rocks.any() else None
    airborne = scene.kind not in LYING
    ground = terrain_surfels(terrain, opacity=0.25 if scene.kind == "pour" else 0.98)
    size = _panel_size(camera.size, config.show.width)
    # a body in the air may fill its box later; what lies on a bed stays in it
    whole = terrain.mesh.vertices
    if airborne:
        inset = 0.18 * (grid.high - grid.low) * np.array([1.0, 1.0, 0.0])
        whole = np.stack([grid.low + inset, grid.high - inset])
    side = side_camera(camera, scene.rest, ground, np.concatenate([scene.rest.means, whole]), size=size)
    sky = np.linspace(0.93, 0.78, size[1], dtype=np.float32)[:, None, None] * np.ones((1, size[0], 3), np.float32)
    shapes = [mesh_surfels(o.mesh, grid.spacing) for o in scene.obstacles]
    for k, (gaussians, _, velocity) in enumerate(splat_frames(folder, len(poses))):
        step(k, len(poses))
        solids = [
            shape.transformed(Similarity3(1.0, matrix_from_quat(p[3:]), p[:3])) for shape, p in zip(shapes, poses[k])
        ]
        front = gaussians
        if solid_depth is not None:
            keep = visible_beside_rocks(gaussians.means, camera, solid_depth, rocks, margin=1.5 * grid.spacing)
            front, velocity = gaussians.select(keep), velocity[keep]
        rendered = render(concatenate([front, *solids]), camera, background=plate)
        picture = _bytes(rendered.image)
        if k < compared:
            measured["frames"].append(picture)
            measured["mask"].append(rendered.alpha > 0.5)
            measured["flow"].append(_screen_velocity(front, velocity, camera, scene.interval, rendered.alpha))
        view = render(concatenate([ground, *solids, gaussians]), side, background=sky)
        panels = [caption(_resized(picture, size), "re-simulation"), caption(_bytes(view.image), "side view")]
        if footage is not None:
            time = footage.start + round(k * scene.interval / scene.clip_interval)
            source = footage.clip.frames[min(time, len(footage.clip) - 1)]
            panels.insert(0, caption(_resized(source, size), "input"))
        yield np.concatenate(panels, axis=1)


def _panel_size(size: tuple[int, int], width: int) -> tuple[int, int]:
    factor = min(1.0, width / max(size))
    return max(2, 2 * round(size[0] * factor / 2)), max(2, 2 * round(size[1] * factor / 2))


def _resized(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    if picture.shape[1::-1] == tuple(size):
        return picture
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def _bytes(image: np.ndarray) -> np.ndarray:
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def _screen_velocity(gaussians, velocity, camera: PinholeCamera, interval: float, alpha) -> np.ndarray:
    """Motion of the re-simulation in the picture, px per frame; NaN where it shows no fluid."""
    from fluidlift.look.rasterize import render

    before, z0 = camera.project(gaussians.means)
    after, z1 = camera.project(gaussians.means + velocity * interval)
    ok = (z0 > 0) & (z1 > 0)
    move = np.where(ok[:, None], after - before, 0.0).astype(np.float32)
    drawn = render(gaussians, camera, features=np.clip(move, -1e3, 1e3)).image
    return np.where(alpha[..., None] > 0.3, drawn / np.maximum(alpha, 0.3)[..., None], np.nan)


def write_report(story: Story, folder: Path, config: JobConfig, timings: dict[str, Any]) -> Path:
    """report.html and the overlay picture."""
    from fluidlift.io.atomic import write_bytes
    from fluidlift.io.images import write_png
    from fluidlift.shape.segment import overlay

    clip, labels = clip_of(story), labels_of(story)
    start = story["geometry"].meta["rest_frame"]
    write_png(folder / "mask_overlay.png", overlay(clip.frames[start], labels.labels[start]))
    write_png(folder / "rest" / "mask.png", np.where(labels.fluid[start], 255, 0).astype(np.uint8))
    sure = np.clip(labels.confidence[start].astype(np.float32), 0.0, 1.0)
    write_png(folder / "rest" / "mask_confidence.png", (255 * sure + 0.5).astype(np.uint8))
    sections = [
        _section_outcome(story),
        _section_seeing(story, overlay),
        _section_body(story),
        _section_motion(story),
        _section_parameters(story),
        _section_simulation(story),
        Section(
            "Time and memory",
            rows=[
                [name, f"{t['seconds']:.1f} s", "from cache" if t["cached"] else "", f"{t['peak_memory_mb']:.0f} MB"]
                for name, t in timings.items()
            ],
            header=["stage", "time", "", "peak memory so far"],
        ),
    ]
    page = report_html(
        f"{clip.source} as a fluid asset",
        f"kind: {_kind(story)} · {len(clip)} frames at {1 / clip.interval:.4g} per second · {clip.size[0]} x "
        f"{clip.size[1]} px · preset {config.preset}",
        sections,
        warnings=story.warnings,
        links={"preview": "preview.mp4", "USD": "asset.usda", "parameters": "parameters.json", "scene": "scene.yaml"},
    )
    return write_bytes(folder / "report.html", page.encode())


def _kind(story: Story) -> str:
    return story["geometry"].meta["kind"]


def _section_outcome(story: Story) -> Section:
    clip, shown = clip_of(story), story["show"].arrays.get("resim_frames", ())
    start = story["geometry"].meta["rest_frame"]
    figures = []
    for k in sorted({0, len(shown) // 2, len(shown) - 1} if len(shown) else ()):
        pair = np.concatenate([clip.frames[min(start + k, len(clip) - 1)], shown[k]], axis=1)
        figures.append(Figure(pair, f"frame {start + k}: input and re-simulation from the same camera"))
    return Section("Input and re-simulation", figures)


def _section_seeing(story: Story, overlay) -> Section:
    from fluidlift.look.pictures import colour_map

    clip, labels = clip_of(story), labels_of(story)
    pick = sorted({0, len(clip) // 2, len(clip) - 1})
    figures = [
        Figure(overlay(clip.frames[t], labels.labels[t]), f"frame {t}: fluid tinted, solids in it marked") for t in pick
    ]
    sure = labels.confidence[pick[1] if len(pick) > 1 else 0].astype(np.float32)
    figures.append(Figure(colour_map(sure, low=0.0, high=1.0), "confidence: dark is a guess, bright is sure"))
    meta, read = story["segment"].meta, story["read"].meta
    rows = [
        ["mask", "given by the user" if meta["user_mask"] else "found from motion and colour"],
        ["mean confidence on the fluid", meta["confidence_mean"]],
        ["share of the picture", meta["fluid_share"]],
        ["camera shake", f"{read['shake_px']:.2f} px per frame" + (", taken out" if read["stabilised"] else "")],
        ["optical flow trusted on", f"{100 * meta['flow_trusted']:.0f} % of the fluid"],
    ]
    return Section("What is fluid", figures, rows)


def _section_body(story: Story) -> Section:
    from fluidlift.look.pictures import colour_map

    g, fitted = story["geometry"], story["refine"].meta
    m = g.meta
    evidence = m["kind_evidence"]
    rows: list[list[Any]] = [
        ["kind", f"{m['kind']} ({m['kind_source']})"],
        ["belief per kind", ", ".join(f"{k} {v:.2f}" for k, v in evidence["scores"].items())],
        ["evidence", ", ".join(f"{k} {v:.2f}" for k, v in evidence["features"].items())],
        *_surface_rows(m),
        ["scale", m["scale"].get("sentence", "").removeprefix("scale: ")],
        ["grid", f"{' x '.join(map(str, m['grid']['shape']))} cells of {1000 * m['grid']['spacing']:.2f} mm"],
        ["frames united", m["united_frames"]],
        ["Gaussians", f"{fitted['total']} ({fitted['front']} seen, {fitted['hull']} hull, {fitted['filled']} inside, "
                      f"{fitted['pruned']} pruned)"],
    ]  # fmt: skip
    if "psnr_before" in fitted:
        kept = "" if fitted["kept"] else " (rejected by the depth guard)"
        rows.append(
            ["single-view refinement", f"PSNR {fitted['psnr_before']:.1f} to {fitted['psnr_after']:.1f} dB{kept}"]
        )
    depth, mask = g.arrays["depth"], g.arrays["mask"]
    figures = [Figure(colour_map(depth, mask & (depth > 0)), "front depth (dark is near)")]
    figures.append(Figure(g.arrays["plate"], "background without the fluid: texture of the terrain"))
    return Section("Body", figures, rows)


def _surface_rows(geometry: dict[str, Any]) -> list[list[str]]:
    """How the camera stands and what the surface was taken from, and how sure both are."""
    up, slope, jets, depth = (geometry.get(k) for k in ("up", "slope", "jets", "depth_source"))
    tilt = f"{up['pitch']:.1f} degrees, rolled {up['roll']:.1f} ({up['source']}, confidence {up['confidence']:.2f})"
    rows = [["camera looks down by", tilt]]
    if depth is not None:
        rows.append(["surface", f"by the {depth['source']}"])
    elif slope is not None:
        level = f"level with a probability of {slope['level_share']:.2f}"
        steep = f"{slope['slope']:.1f} ± {slope['standard_error']:.1f} degrees, {level} ({slope['source']})"
        rows.append(["slope of the surface", steep])
    if jets:
        rows.append(["jets above it", str(len(jets))])
    return rows


def _section_motion(story: Story) -> Section:
    from fluidlift.look.pictures import velocity_slices
    from fluidlift.motion.optical_flow import flow_picture

    meta, a = story["motion"].meta, story["motion"].arrays
    figures = []
    if meta["targets"]:
        t = meta["targets"][0]
        raw, full = (np.asarray(x[t], np.float32) for x in (flow_of(story).displacement, a["completed"]))
        mask = labels_of(story).fluid[t]
        scale = float(np.percentile(np.linalg.norm(full[mask], axis=-1), 95)) if mask.any() else 1.0
        figures = [
            Figure(flow_picture(raw, mask, scale), f"optical flow at frame {t} (hue: direction, value: speed)"),
            Figure(flow_picture(full, mask, scale), "averaged over neighbouring frames, mainstream-corrected"),
        ]
        cells = setting_of(story).cell_types
        wet = (cells == CellType.FLUID) | (cells == CellType.INFLOW)
        figures.append(
            Figure(
                velocity_slices(targets_of(story)[0].at_centers(), wet),
                "speed in the volume: from above, along, across",
            )
        )
    rows = [
        [
            r["frame"],
            r.get("divergence_max", ""),
            r.get("divergence_mean", ""),
            r.get("flux_in", ""),
            r.get("flux_out", ""),
        ]
        for r in meta["reports"][:12]
    ]
    return Section(
        "Motion", figures, rows, ["frame", "max |div| dx / speed", "mean", "flux in, m3/s", "flux out, m3/s"]
    )


def _section_parameters(story: Story) -> Section:
    from fluidlift.look.pictures import curve

    meta, g = story["fit"].meta, story["geometry"].meta
    # an asset of an earlier version has no such table
    table = meta.get("table", ())
    rows = [[r["name"], r["value"], r["unit"], in_words(r), how_sure(r), r["prior"], r["source"]] for r in table]
    loss = story["fit"].arrays["loss_history"]
    figures = []
    if len(loss):
        picture = curve(loss, title="data term of the fit", x="iteration", y="loss")
        figures.append(
            Figure(picture, "misfit of the velocities; it may rise once the noise is known and priors count")
        )
    how = {"fitted": "The fit converged.", "unfinished": "The fit did not converge: best values so far."}
    status = meta.get("status", "fitted" if meta["converged"] else "unfinished")
    said = how.get(status, f"The fit failed: {meta.get('reason', '')}. The first guess is kept.")
    scale = g["scale"].get("sentence", f"scale: {g['scale']['source']}")
    return Section(
        "Physical parameters", figures, rows,
        ["parameter", "value", "unit", "between (95 %)", "how sure", "first guess", "where it comes from"],
        [said, scale[:1].upper() + scale[1:] + ".", *TIES, *meta["notes"]],
    )  # fmt: skip


def _section_simulation(story: Story) -> Section:
    from fluidlift.look.pictures import curve

    a = story["simulate"].arrays
    figures = [
        Figure(
            curve(a["volume"] / max(a["volume"][0], 1e-12), title="volume over its start", x="frame", y="ratio"),
            "volume",
        ),
        Figure(curve(a["count"], title="particles", x="frame", y="count"), "particles"),
    ]
    rows = [["largest share of particles inside the terrain", f"{100 * float(a['leak'].max()):.2f} %"]]
    return Section("Re-simulation", figures, rows)
