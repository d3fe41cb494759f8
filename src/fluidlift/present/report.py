"""report.html: what was found, how sure it is, and what to look for in every picture."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.fit.outcome import TIES, how_sure, in_words
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.look.clear_water import CHANNELS, NAME, absorption_in
from fluidlift.look.report import Figure, Section, report_html
from fluidlift.present.as_filmed import card_of, certainty
from fluidlift.scene.filmed_numbers import NAMES
from fluidlift.types import CellType, kind_of
from fluidlift.types.stages import Fit, Geometry, Lift, Read, Refined, Shown, Simulation

FILM_MAX = 12_000_000
"""bytes of a preview that goes into the page: it should still open at once and fit into a mail"""


def write_report(
    lift: Lift, simulation: Simulation, shown: Shown, folder: Path, preset: str, timings: dict[str, Any],
    warnings: Sequence[str], models: Sequence[Mapping[str, Any]] = (),
) -> Path:  # fmt: skip
    """report.html and the overlay picture.

    Args:
        lift: what was found in the clip.
        simulation: of it.
        shown: what was measured on its frames.
        folder: of the asset.
        preset: of the job.
        timings: of the stages.
        warnings: for its head.
        models: learned ones that looked at the clip, as the manifest has them.
    """
    from fluidlift.io.atomic import write_bytes
    from fluidlift.io.images import write_png
    from fluidlift.shape.segment import overlay

    clip, labels, start = lift.clip, lift.labels, lift.geometry.rest_frame
    write_png(folder / "mask_overlay.png", overlay(clip.frames[start], labels.labels[start]))
    write_png(asset_file(folder, "rest/mask.png"), np.where(labels.fluid[start], 255, 0).astype(np.uint8))
    sure = np.clip(labels.confidence[start].astype(np.float32), 0.0, 1.0)
    write_png(asset_file(folder, "rest/mask_confidence.png"), (255 * sure + 0.5).astype(np.uint8))
    sections = [
        _section_as_filmed(lift, shown),
        _section_outcome(lift, shown),
        _section_seeing(lift, overlay, models),
        *_section_models(models),
        _section_body(lift.geometry, lift.refined),
        _section_motion(lift),
        _section_parameters(lift.fit, lift.geometry.scale_sentence, _filmed_rows(folder)),
        _section_simulation(simulation),
        _section_next(folder),
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
        f"kind: {lift.geometry.kind} · {len(clip)} frames at {1 / clip.interval:.4g} per second · {clip.size[0]} x "
        f"{clip.size[1]} px · preset {preset}",
        sections,
        warnings=warnings,
        film=_film(folder / "preview.mp4"),
        links={"preview": "preview.mp4", "USD": "asset.usda", "parameters": "parameters.json", "scene": "scene.yaml"},
    )
    return write_bytes(folder / "report.html", page.encode())


def _section_next(folder: Path) -> Section:
    """What an asset is made for, as commands."""
    name = shlex.quote(folder.name)
    return Section(
        "What next",
        notes=["In the folder that holds the asset:"],
        commands=[
            (f"fluidlift view {name}", "look around it, change it, see the change"),
            (f"fluidlift edit {name} --material honey", "or --set, --add, --remove; --undo takes it back"),
            (f"fluidlift sim {name} --duration 20", "longer, or with the edits"),
            (f"fluidlift render {name} -o turn.mp4 --view turn", "from any camera, also with --look surface"),
            (f"fluidlift export {name} -o page.html --to html", "or mesh, usd, vdb, splats, gltf for other tools"),
        ],
    )


def _film(path: Path) -> bytes:
    """The preview, where it is small enough to go into the page."""
    return path.read_bytes() if path.is_file() and path.stat().st_size <= FILM_MAX else b""


def _section_as_filmed(lift: Lift, shown: Shown) -> Section:
    """The card, first of all: whether what follows can be used."""
    from fluidlift.evaluate.as_filmed import HEADER

    card = card_of({"simulation": {"as_filmed": shown.as_filmed}, "metrics": {"certainty": certainty(lift)}})
    if isinstance(card, str):
        return Section("As filmed", notes=[f"How near the re-simulation stays to the clip is not known: {card}."])
    said = card.sentence()
    how = f"{card.frames} frames were compared with the clip at the same time, {card.beyond} after its end. "
    how += "The floor is the same figure between the two halves of the clip (current: its first and last third)."
    return Section(
        "As filmed", (), card.rows(), HEADER, [said[:1].upper() + said[1:] + ".", how, *card.notes, *card.advice]
    )


def _section_outcome(lift: Lift, seen: Shown) -> Section:
    clip, start = lift.clip, lift.geometry.rest_frame
    shown = () if seen.pictures is None else seen.pictures
    figures = []
    for k in sorted({0, len(shown) // 2, len(shown) - 1} if len(shown) else ()):
        pair = np.concatenate([clip.frames[min(start + k, len(clip) - 1)], shown[k]], axis=1)
        figures.append(
            Figure(
                pair,
                f"Frame {FIRST_FRAME + k}, {k * clip.interval:.2f} s: the clip (left) and the re-simulation from "
                "the same camera (right)",
                "same outline and colours; the pattern need not be the same, how it moves should be",
            )
        )
    return Section("Input and re-simulation", figures)


def _section_models(models: Sequence[Mapping[str, Any]]) -> list[Section]:
    """Which learned models looked at the clip, to the bit; nothing where none did."""
    if not models:
        return []
    rows = [
        [m["for"], m["name"], m["method"], m.get("terms", "see its page"),
         ", ".join(f"{name} {sha256}" for name, sha256 in m["files"].items())]
        for m in models
    ]  # fmt: skip
    note = "A learned model can be wrong, too: look at the mask and the distance of the surface."
    return [Section("Learned models", rows=rows, header=["for", "model", "by", "licence", "SHA-256"], notes=[note])]


def _section_seeing(lift: Lift, overlay, models: Sequence[Mapping[str, Any]]) -> Section:
    from fluidlift.look.pictures import colour_map

    clip, labels = lift.clip, lift.labels
    pick = sorted({0, len(clip) // 2, len(clip) - 1})
    figures = [
        Figure(
            overlay(clip.frames[t], labels.labels[t]),
            f"The clip at {t * clip.interval:.2f} s: what is taken for fluid is tinted, solids in it are marked",
            "the tint covers the fluid up to its edge and nothing else; correct it with fluidlift mask",
        )
        for t in pick
    ]
    sure = labels.confidence[pick[1] if len(pick) > 1 else 0].astype(np.float32)
    figures.append(
        Figure(
            colour_map(sure, low=0.0, high=1.0),
            "How sure the mask is: dark is a guess, bright is sure",
            "bright everywhere but along a thin line at the edge",
        )
    )
    found, read = lift.segmentation, lift.read
    by = next((f"by {m['name']}" for m in models if m["for"] == "masks"), "from motion and colour")
    rows = [
        ["mask", "given by the user" if found.user_mask else f"found {by}"],
        ["mean confidence on the fluid", found.confidence_mean],
        ["share of the picture", found.fluid_share],
        ["camera shake", f"{read.shake_px:.2f} px per frame" + (", taken out" if read.stabilised else "")],
        *_view_rows(read),
        ["optical flow trusted on", f"{100 * found.flow_trusted:.0f} % of the fluid"],
    ]
    return Section("What is fluid", figures, rows)


def _view_rows(read: Read) -> list[list[Any]]:
    """What the path of a camera that went somewhere has measured."""
    view = read.view
    if view is None:
        return []
    lens = f"focal length {view.focal:.0f} px"
    if not np.isfinite(view.focal_error):
        lens += " (assumed: the path does not tell it)"
    elif view.focal_error > 0:
        lens += f" (measured, to {100 * view.focal_error:.0f} %)"
    return [
        ["path of the camera", f"found from {view.points} points that stand, seen to {view.error_px:.2f} px; {lens}"],
        ["plane of the water", f"measured: the camera looks {view.pitch:.1f} degrees down on it, rolled by "
         f"{view.roll:.1f}; {100 * view.support:.0f} % of the shore lies on it"],
    ]  # fmt: skip


def _section_body(g: Geometry, fitted: Refined) -> Section:
    from fluidlift.look.pictures import colour_map

    evidence, grid = g.kind_evidence, g.grid
    rows: list[list[Any]] = [
        ["kind", f"{g.kind} ({g.kind_source})"],
        ["belief per kind", ", ".join(f"{k} {v:.2f}" for k, v in evidence.scores.items())],
        ["evidence", ", ".join(f"{k} {v:.2f}" for k, v in evidence.features.items())],
        *_surface_rows(g),
        ["scale", g.scale_sentence.removeprefix("scale: ")],
        ["grid", f"{' x '.join(map(str, grid.shape))} cells of {1000 * grid.spacing:.2f} mm"],
        ["frames united", g.united_frames],
        ["Gaussians", f"{len(fitted.body)} ({fitted.front} seen, {fitted.hull} hull, {fitted.filled} inside, "
                      f"{fitted.pruned} pruned)"],
    ]  # fmt: skip
    if fitted.psnr_before is not None and fitted.psnr_after is not None:
        kept = "" if fitted.kept else " (rejected by the depth guard)"
        rows.append(["single-view refinement", f"PSNR {fitted.psnr_before:.1f} to {fitted.psnr_after:.1f} dB{kept}"])
    depth, mask = g.depth, g.mask
    figures = [
        Figure(
            colour_map(depth, mask & (depth > 0)),
            "Distance of the visible surface: dark is near",
            "a smooth slope that fits the scene; steps and holes mean a wrong surface: give --depth or --pitch",
        ),
        Figure(
            g.plate,
            "The clip without its fluid, which becomes the texture of the ground",
            "bed and banks alone; what is left of the fluid will stick to the ground",
        ),
    ]
    return Section("Body", figures, rows)


def _surface_rows(geometry: Geometry) -> list[list[str]]:
    """How the camera stands and what the surface was taken from, and how sure both are."""
    up, slope, depth = geometry.up, geometry.slope, geometry.depth_source
    error = f" ± {up.error:.0f}" if up.error else ""
    built = f", built as from {up.pitch:.1f}" if up.raised else ""  # what was seen is sure to so much, not the relief
    sure = f"({up.source}, confidence {up.confidence:.2f})"
    tilt = f"{up.pitch - up.raised:.1f}{error} degrees{built}, rolled {up.roll:.1f} {sure}"
    rows = [["camera looks down by", tilt]]
    if depth is not None:
        rows.append(["surface", f"by the {depth['source']}"])
    elif slope is not None:
        level = f"level with a probability of {slope.level_share:.2f}"
        steep = f"{slope.slope:.1f} ± {slope.standard_error:.1f} degrees, {level} ({slope.source})"
        rows.append(["slope of the surface", steep])
    if kind_of(geometry.kind).is_channel_flow:
        rows.append(["bed under the water", _bed_in_words(geometry)])
    if geometry.jets:
        rows.append(["jets above it", str(len(geometry.jets))])
    return rows


def _bed_in_words(geometry: Geometry) -> str:
    """How much of the bed is seen, and what its water absorbs."""
    bed = geometry.bed
    if bed is None:
        return "not seen through the water: its texture goes on from the banks"
    known = [bed.estimates[f"{NAME}_{c}"] for c in CHANNELS]
    said = f"seen through {100 * bed.share:.0f} % of it, as it is painted on the ground"
    if absorption_in(bed.estimates) is None:
        return f"{said}; what the water absorbs cannot be told from it (pure water's is taken)"
    parts = [f"{e.value:.2f} ({e.interval[0]:.2f} to {e.interval[1]:.2f})" for e in known if e.interval is not None]
    return f"{said}; the water absorbs, for the depth that was built, per m of red, green and blue {', '.join(parts)}"


def _section_motion(lift: Lift) -> Section:
    from fluidlift.look.pictures import velocity_slices
    from fluidlift.motion.optical_flow import flow_picture

    motion = lift.motion
    figures = []
    if motion.targets:
        t = motion.targets[0].frame
        raw, full = (np.asarray(x[t], np.float32) for x in (lift.flow.flow.displacement, motion.completed))
        mask = lift.labels.fluid[t]
        scale = float(np.percentile(np.linalg.norm(full[mask], axis=-1), 95)) if mask.any() else 1.0
        figures = [
            Figure(
                flow_picture(raw, mask, scale),
                f"Motion between frames {t} and {t + 1} as measured: hue is direction, brightness is speed",
                "one family of hues along the stream; speckle is where the picture shows no motion",
            ),
            Figure(
                flow_picture(full, mask, scale),
                "The same after averaging over neighbouring frames and filling along the main stream",
                "smooth, no holes, faster in the middle than at the banks",
            ),
        ]
        cells = lift.geometry.setting.cell_types
        wet = (cells == CellType.FLUID) | (cells == CellType.INFLOW)
        figures.append(
            Figure(
                velocity_slices(motion.targets[0].velocity.at_centers(), wet),
                "Speed in the volume: from above, along the stream, across it",
                "slower towards the bed, nowhere cut off inside the fluid",
            )
        )
    rows = [
        [
            r["frame"],
            r.get("divergence_max", ""),
            r.get("divergence_mean", ""),
            r.get("flux_in", 0.0) + 0.0,  # no minus nothing
            r.get("flux_out", 0.0) + 0.0,
        ]
        for r in motion.reports[:12]
    ]
    return Section(
        "Motion", figures, rows, ["frame", "max |div| dx / speed", "mean", "flux in, m3/s", "flux out, m3/s"]
    )


def _filmed_rows(folder: Path) -> list[list[Any]]:
    """Foam and waves, as the parameters of the asset have them."""
    from fluidlift.io.asset_folder import read_parameters

    known = read_parameters(asset_file(folder, "parameters.json"))[1]
    rows = [{"name": n, **vars(known[n])} for n in NAMES if n in known]
    return [[r["name"], r["value"], r["unit"], in_words(r), how_sure(r), "", r["source"]] for r in rows]


def _section_parameters(fit: Fit, scale: str, beside: list[list[Any]]) -> Section:
    from fluidlift.look.pictures import curve

    rows = [[r["name"], r["value"], r["unit"], in_words(r), how_sure(r), r["prior"], r["source"]] for r in fit.table]
    rows += beside
    loss = fit.loss_history
    figures = []
    if len(loss):
        picture = curve(loss, title="data term of the fit", x="iteration", y="loss")
        figures.append(
            Figure(
                picture,
                "Misfit of the velocities over the steps of the fit",
                "falls and levels out; it may rise again once the noise is known and priors count",
            )
        )
    how = {"fitted": "The fit converged: misfit over its noise and priors together fall no more.",
           "unfinished": "The fit did not converge: best values so far.",
           "left": f"Not fitted: {fit.reason}."}  # fmt: skip
    said = how.get(fit.status, f"The fit failed: {fit.reason}. The first guess is kept.")
    return Section(
        "Physical parameters", figures, rows,
        ["parameter", "value", "unit", "between (95 %)", "how sure", "first guess", "where it comes from"],
        [said, scale[:1].upper() + scale[1:] + ".", *TIES, *fit.notes],
    )  # fmt: skip


def _section_simulation(done: Simulation) -> Section:
    from fluidlift.look.pictures import curve

    figures = [
        Figure(
            curve(done.volume / max(done.volume[0], 1e-12), title="volume over its start", x="frame", y="ratio"),
            "Volume of the simulated fluid, as a multiple of the first frame's",
            "close to 1 all the way; a slope means more flows in than out, or the reverse",
        ),
        Figure(
            curve(done.count, title="particles", x="frame", y="count"),
            "Particles of the simulation",
            "level, or slowly rising while an inlet fills; a fall means fluid that left",
        ),
    ]
    rows = [["largest share of particles inside the terrain", f"{100 * float(done.leak.max()):.2f} %"]]
    return Section("Re-simulation", figures, rows)
