"""A thousand results on one page, which works offline: overlay and preview of each shot, the most doubtful first."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.farm.state import ShotOutcome
from fluidlift.farm.summary import Status

WIDTH = 240
"""px of a thumbnail: two side by side are judged at a glance, and a thousand shots take some 20 MB"""
TALLEST = 4
"""times as high as wide, at most: a picture of one column would become millions of rows"""
_DOUBT = {"good": 0.0, "usable": 1.0, "": 1.5, "does not hold": 2.0}
"""by the verdict; a shot that failed has 3, and each warning adds a tenth"""
_STYLE = """
:root { color-scheme: light dark; --line: #8884; }
body { font: 14px/1.4 system-ui, sans-serif; margin: 16px; }
#shots { display: grid; grid-template-columns: repeat(auto-fill, minmax(300px, 1fr)); gap: 12px; }
article { border: 1px solid var(--line); border-radius: 8px; padding: 8px; overflow-wrap: anywhere; }
article img { width: 49%; vertical-align: top; border-radius: 4px; }
h2 { font-size: 14px; margin: 0 0 4px; } p { margin: 4px 0; } ul { margin: 4px 0; padding-left: 18px; }
.failed { border-color: #c33; } .doubt { border-color: #c90; }
input { font: inherit; padding: 4px 8px; width: min(420px, 90%); margin: 8px 0; }
"""
_SCRIPT = """
const find = document.getElementById("find"), all = [...document.querySelectorAll("article")];
find.oninput = () => { const words = find.value.toLowerCase().split(/\\s+/).filter(Boolean);
  for (const a of all) a.hidden = !words.every((w) => a.textContent.toLowerCase().includes(w)); };
"""


def doubt(outcome: ShotOutcome) -> float:
    """How much an outcome should be looked at, 0 for nothing."""
    return (_DOUBT.get(outcome.verdict, 1.5) if outcome.well else 3.0) + 0.1 * len(outcome.warnings)


def page(folder: Path, status: Status) -> str:
    """HTML of a folder of shots."""
    shown = sorted(status.outcomes, key=lambda o: (-doubt(o), o.name))
    head = "".join(f"<p>{escape(line)}</p>" for line in status.lines()[:3])
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>fluidlift: shots</title>'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; "
        "script-src 'unsafe-inline'; img-src data:\">"
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head><body><h1>Shots</h1>{head}'
        '<input id="find" placeholder="words that a shot has: a name, usable, failed, memory ..." aria-label="filter">'
        f'<div id="shots">{"".join(_article(folder, o) for o in shown)}</div><script>{_SCRIPT}</script></body></html>\n'
    )


def _article(folder: Path, outcome: ShotOutcome) -> str:
    asset = folder / f"{outcome.name}.fluid"
    pictures = [p for p in (_overlay(asset), _preview(asset)) if p is not None] if outcome.well else []
    told = outcome.verdict or "not measured" if outcome.well else f"failed: {outcome.failure}"
    facts = f"{told} · {outcome.seconds:.0f} s · {outcome.peak_memory_mb:.0f} MB"
    notes = [outcome.reason] * bool(outcome.reason) + outcome.warnings
    kind = "failed" if not outcome.well else "doubt" if doubt(outcome) >= 1.5 else "fine"
    return (
        f'<article class="{kind}"><h2>{escape(outcome.name)}</h2>'
        + "".join(f'<img loading="lazy" alt="{name}" src="{_jpeg(p)}"> ' for p, name in zip(pictures, ("mask", "end")))
        + f"<p>{escape(facts)}</p><ul>{''.join(f'<li>{escape(n)}</li>' for n in notes)}</ul></article>"
    )


def _overlay(asset: Path) -> np.ndarray | None:
    """What was taken for fluid."""
    from fluidlift.io.asset_paths import asset_file
    from fluidlift.io.pictures import eight_bit, read_picture

    try:
        return eight_bit(read_picture(asset_file(asset, "mask_overlay.png")))[0]
    except (InputRejected, OSError):
        return None


def _preview(asset: Path) -> np.ndarray | None:
    """The last frame of the preview: what stays right to the end."""
    from fluidlift.io.asset_paths import asset_file
    from fluidlift.io.decode import Notes, decode_frames, open_video
    from fluidlift.io.limits import ReadLimits

    limits, last = ReadLimits(), None
    try:
        with open_video(asset_file(asset, "preview.mp4"), limits) as (container, stream):
            for _, frame in decode_frames(container, stream, limits, Notes()):
                last = frame
    except (InputRejected, OSError):
        return None
    if last is None or last.width < 3:
        return None
    picture = last.to_ndarray(format="rgb24")
    return picture[:, picture.shape[1] // 3 : 2 * (picture.shape[1] // 3)]


def _jpeg(picture: np.ndarray) -> str:
    import cv2

    height = min(max(round(picture.shape[0] * WIDTH / picture.shape[1]), 1), TALLEST * WIDTH)
    small = cv2.resize(np.ascontiguousarray(picture[..., :3]), (WIDTH, height), interpolation=cv2.INTER_AREA)
    data: Sequence[int] = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()
    return "data:image/jpeg;base64," + base64.b64encode(bytes(data)).decode()
