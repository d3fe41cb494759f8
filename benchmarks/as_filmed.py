"""How near re-simulations stay to their clips: the card of each asset as a row, and how well it holds beyond its clip.

    python benchmarks/as_filmed.py river.fluid honey.fluid
    python benchmarks/as_filmed.py --make river.mp4 honey.mp4 --work runs
    python benchmarks/as_filmed.py --make river.mp4 --work runs --held-out
    python benchmarks/as_filmed.py --make clips/*/video.mp4 --seconds 1.2 --jobs 16 --limit 400 --thin

Figures are those of `fluidlift evaluate ASSET` (docs/cli.md), each with the same figure between the halves of the clip
in brackets and, after a comma, that of the frames after the clip's end. `--make` makes drafts and simulates them to
three times the length of the clip. With `--held-out` they are made from the first two thirds of the clip and held
against the last third, which they have not seen. What lies in the work folder is not made again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
from report import table

from fluidlift.errors import InputRejected
from fluidlift.evaluate.as_filmed import AsFilmed, Likeness
from fluidlift.io.asset_folder import read_manifest
from fluidlift.io.video import probe
from fluidlift.machine import THREADS, cores
from fluidlift.pipeline import card_against, card_of

COLUMNS = {
    "level": "level", "mean": "mean picture", "ring": "ring", "liveliness": "liveliness",
    "along_0.5": "alike 0.5 s downstream", "crispness_0": "crispness", "colours": "colours", "foam": "foam",
    "current_error": "current off by", "current_cosine": "cosine",
}  # fmt: skip
LENGTH = 3.0
"""times the clip, to which a re-simulation is played"""
WELL = (0, 4)
"""exit codes: done, done with warnings"""


def fluidlift(*words: str, threads: int = 0) -> None:
    """Run a command, on so many threads; stop where it fails."""
    env = os.environ | dict.fromkeys(THREADS, str(threads)) if threads else None
    done = subprocess.run([sys.executable, "-m", "fluidlift", *words], check=False, env=env)
    if done.returncode not in WELL:
        raise SystemExit(f"fluidlift {' '.join(words)}: exit code {done.returncode}")


@dataclass(frozen=True)
class Way:
    """How assets are made."""

    work: Path
    held_out: bool = False
    seconds: float | None = None
    """of each clip, from its middle; None: the whole"""
    size: int | None = None
    """px of the longer side; None: as the preset says"""
    threads: int = 0
    """of each; 0: as many as there are"""
    thin: bool = False
    end: float = float("inf")
    """time.monotonic, s, after which nothing is begun"""

    def part(self, clip: Path) -> tuple[float, float]:
        """s: where what is taken of a clip begins, and how long it is."""
        whole = probe(clip).duration
        taken = min(self.seconds or whole, whole)
        return 0.5 * (whole - taken), taken

    def made(self, clip: Path, folder: Path) -> float:
        """Make the asset and play it to three times its length; gives the s of the clip after what it was made from."""
        start, taken = self.part(clip)
        made = taken * (2.0 / 3.0 if self.held_out else 1.0)
        if not (folder / "manifest.json").is_file():
            part = ("--start", f"{start:.4f}", "--duration", f"{made:.4f}") if self.seconds or self.held_out else ()
            size = ("--max-size", str(self.size)) if self.size else ()
            fluidlift("make", str(clip), "-o", str(folder), *part, *size, threads=self.threads)
            fluidlift("sim", str(folder), "--duration", f"{LENGTH * made:.4f}", threads=self.threads)
        return start + made

    def card(self, clip: Path) -> tuple[str, dict[str, Any] | None]:
        """Name and card, as plain values, of one clip; no card where the time was over."""
        name = (clip.parent.name if clip.stem == "video" else clip.stem) + "_held_out" * self.held_out
        kept, folder = self.work / f"{name}.json", self.work / f"{name}.fluid"
        if kept.is_file():
            return name, json.loads(kept.read_text(encoding="utf-8"))
        if time.monotonic() > self.end:
            return name, None
        began = time.monotonic()
        try:
            after = self.made(clip, folder)
        except SystemExit as failure:
            return name, {"none": str(failure)}
        took = time.monotonic() - began
        try:
            found = card_against(folder, clip, start=after) if self.held_out else card_of(read_manifest(folder))
        except InputRejected as refused:  # a third of a clip of ten frames
            found = str(refused)
        plain = {"none": found} if isinstance(found, str) else found.to_dict()
        plain |= {"took": round(took, 1), "kind": read_manifest(folder).get("kind")}
        picture(folder / "preview.mp4", kept.with_suffix(".jpg"), 1.0 / LENGTH)
        kept.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")
        if self.thin:
            shutil.rmtree(folder)
        return name, plain


def picture(film: Path, out: Path, filmed: float) -> None:
    """The first, the last filmed and the last frame of a preview, one below the other."""
    frames = list(_frames(film))
    if frames:
        shown = [frames[round(share * (len(frames) - 1))] for share in (0.0, filmed, 1.0)]
        cv2.imwrite(str(out), np.vstack(shown), [cv2.IMWRITE_JPEG_QUALITY, 80])


def _frames(film: Path) -> Iterator[np.ndarray[Any, Any]]:
    reader = cv2.VideoCapture(str(film))
    while (read := reader.read())[0]:
        yield read[1]


def text_of(figure: Likeness) -> str:
    """Value, floor in brackets, value after the end of the clip."""
    value, floor, beyond = ("-" if v is None else f"{v:.2f}" for v in (figure.value, figure.floor, figure.beyond))
    return f"{value} ({floor})" + (f", {beyond}" if figure.beyond is not None else "")


def row(name: str, card: AsFilmed | str) -> list[str]:
    """Of the table."""
    if isinstance(card, str):
        return [name, f"none: {card}", *[""] * len(COLUMNS)]
    return [name, str(card.verdict), *(text_of(card[key]) for key in COLUMNS)]


def medians(cards: list[AsFilmed]) -> list[str]:
    """The last row of the table: medians of the values, of the floors, and of what comes after the clips' ends."""
    cells = []
    for key in COLUMNS:
        columns = zip(*((f.value, f.floor, f.beyond) for f in (card[key] for card in cards)), strict=True)
        known = [[v for v in column if v is not None] for column in columns]
        value, floor, beyond = (f"{median(v):.2f}" if v else "-" for v in known)
        cells.append(f"{value} ({floor}), {beyond}")
    return [f"median of {len(cards)}", "", *cells]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", nargs="*", type=Path)
    parser.add_argument("--make", nargs="+", type=Path, default=[], metavar="CLIP", help="clips to make drafts of")
    parser.add_argument("--held-out", action="store_true", help="make from two thirds, hold against the last one")
    parser.add_argument("--work", type=Path, default=Path("runs"), help="folder for what is made")
    parser.add_argument("--seconds", type=float, help="of each clip, from its middle")
    parser.add_argument("--max-size", type=int, help="longer side, px")
    parser.add_argument("--jobs", type=int, default=1, help="clips at once")
    parser.add_argument("--limit", type=float, default=float("inf"), help="s, after which none is begun")
    parser.add_argument("--thin", action="store_true", help="remove each asset when its card is written")
    parser.add_argument("--json", type=Path, help="file for the cards")
    a = parser.parse_args()
    plain: dict[str, Any] = {}
    for folder in a.assets:
        card = card_of(read_manifest(folder))
        plain[folder.stem] = {"none": card} if isinstance(card, str) else card.to_dict()
    a.work.mkdir(parents=True, exist_ok=True)
    threads = max(cores() // a.jobs, 1) if a.jobs > 1 else 0
    way = Way(a.work, a.held_out, a.seconds, a.max_size, threads, a.thin, time.monotonic() + a.limit)
    with ThreadPoolExecutor(a.jobs) as several:
        plain |= {name: card for name, card in several.map(way.card, a.make) if card is not None}
    cards = {name: c["none"] if "none" in c else AsFilmed.from_dict(c) for name, c in plain.items()}
    rows = [row(*item) for item in cards.items()]
    judged = [card for card in cards.values() if isinstance(card, AsFilmed)]
    rows += [medians(judged)] if len(judged) > 1 else []
    print("\n".join(table(["asset", "verdict", *COLUMNS.values()], rows)))
    if a.json:
        a.json.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
