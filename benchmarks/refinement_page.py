"""Tables of `refinement.py`."""

from __future__ import annotations

from typing import Any

STEPS_HEADER = [
    "clip", "step", "Gaussians", "PSNR dB", "SSIM", "depth error %", "95 %", "beside dB", "IoU", "over rocks",
]  # fmt: skip


def page(records: list[dict[str, Any]]) -> str:
    """Markdown of all records."""
    subjects = sorted((r for r in records if "steps" in r), key=_order)
    out = ["A body on the true surface, as a generator might give it:", "", *_steps(subjects, "steps")]
    out += ["", "Beside: 20 degrees from the side; the frame on the true surface, or filmed by a second camera.", ""]
    out += [
        f"{r['name']}: filmed by a second camera; the frame on the true surface reaches {r['ceiling']:.2f} dB there."
        for r in subjects if r["held_out"] == "filmed"
    ] + [""]  # fmt: skip
    out += ["The pipeline's own body, with the case's camera:", "", *_steps(subjects, "estimated")]
    out += ["", "### Frames after the first", ""]
    out += _table(
        ["clip", "started from the last, dB", "after a fifth of the steps", "a new start after as many"],
        [[r["name"], *(_n(sum(x[i] for x in r["later"]) / len(r["later"]), 2) for i in range(3))]
         for r in subjects if r["later"]],
    )  # fmt: skip
    out += ["", "### Terms of the loss", ""]
    out += _table(
        ["clip", "loss", "Gaussians", "PSNR dB", "beside dB", "depth error %", "needles", "largest / median",
         "out of [0, 1]"],
        [
            [r["name"] if k == 0 else "", s["step"], s["gaussians"], _n(s["psnr"], 2), _n(s["side_psnr"], 2),
             _n(100 * s["depth"], 2), _n(s["needles"]), _n(s["largest"], 1), _n(s["oversaturated"], 4)]
            for r in subjects for k, s in enumerate(r["losses"])
        ],
    )  # fmt: skip
    change = "Mean change from frame to frame over the thickness of the body."
    out += ["", "### Flicker of the far side", "", change, ""]
    out += _table(
        ["clip", "frames", "N", "single bodies", "united", "thickness, united over single"],
        [[r["name"], f["frames"], f["window"], _n(f["single"]), _n(f["united"]),
          _n(f["united_thickness"] / f["single_thickness"], 2)] for r in subjects if (f := r["flicker"])],
    )  # fmt: skip
    for s in (r["speed"] for r in records if "speed" in r):
        size = f"One frame of {s['side']} x {s['side']} px with {s['gaussians']} Gaussians"
        likeness = f"{s['psnr_before']:.1f} to {s['psnr_after']:.1f} dB"
        out += ["", f"{size}: {s['iterations']} steps in {s['seconds']} s of one core, {likeness}."]
    return "\n".join(out) + "\n"


def _order(record: dict[str, Any]) -> tuple[bool, str]:
    """The package's own scenes first."""
    return (record["name"] != "demo" and not record["name"].startswith("scene_"), record["name"])


def _steps(subjects: list[dict[str, Any]], which: str) -> list[str]:
    return _table(
        STEPS_HEADER,
        [
            [r["name"] if k == 0 else "", s["step"], s["gaussians"], _n(s["psnr"], 2), _n(s["ssim"]),
             _n(100 * s["depth"], 2), _n(100 * s["depth_95"], 1), _n(s["side_psnr"], 2), _n(s.get("iou")),
             _n(s["rocks"], 2)]
            for r in subjects for k, s in enumerate(r.get(which, []))
        ],
    )  # fmt: skip


def _table(header: list[str], rows: list[list[Any]]) -> list[str]:
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(str(x) for x in line) + " |" for line in lines]


def _n(value: float | None, digits: int = 3) -> str:
    return "" if value is None else f"{value:.{digits}f}"
