"""How near re-simulations stay to their clips: the card of each asset as a row, and how well it holds beyond its clip.

    python benchmarks/as_filmed.py river.fluid honey.fluid
    python benchmarks/as_filmed.py --make river.mp4 honey.mp4 --work runs
    python benchmarks/as_filmed.py --make river.mp4 --work runs --held-out

Figures are those of `fluidlift evaluate ASSET` (docs/cli.md), each with the same figure between the halves of the clip
in brackets and, after a comma, that of the frames after the clip's end. `--make` makes drafts and simulates them to
three times the length of the clip. With `--held-out` they are made from the first two thirds of the clip and held
against the last third, which they have not seen. What lies in the work folder is not made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from report import table

from fluidlift.evaluate.as_filmed import AsFilmed, Likeness
from fluidlift.io.asset_folder import read_manifest
from fluidlift.io.video import probe
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


def fluidlift(*words: str) -> None:
    """Run a command; stop where it fails."""
    done = subprocess.run([sys.executable, "-m", "fluidlift.cli", *words], check=False)
    if done.returncode not in WELL:
        raise SystemExit(f"fluidlift {' '.join(words)}: exit code {done.returncode}")


def made(clip: Path, work: Path, held_out: bool) -> tuple[Path, float]:
    """The asset of a clip, played to three times its length, and the seconds of the clip that it was made from."""
    name = clip.parent.name if clip.stem == "video" else clip.stem
    info = probe(clip)
    seconds = info.duration * (2.0 / 3.0 if held_out else 1.0)
    folder = work / f"{name}{'_held_out' * held_out}.fluid"
    if not (folder / "manifest.json").is_file():
        fluidlift("make", str(clip), "-o", str(folder), *(("--duration", f"{seconds:.4f}") if held_out else ()))
        fluidlift("sim", str(folder), "--duration", f"{LENGTH * seconds:.4f}")
    return folder, seconds


def text_of(figure: Likeness) -> str:
    """Value, floor in brackets, value after the end of the clip."""
    value, floor, beyond = ("-" if v is None else f"{v:.2f}" for v in (figure.value, figure.floor, figure.beyond))
    return f"{value} ({floor})" + (f", {beyond}" if figure.beyond is not None else "")


def row(name: str, card: AsFilmed | str) -> list[str]:
    """Of the table."""
    if isinstance(card, str):
        return [name, f"none: {card}", *[""] * len(COLUMNS)]
    return [name, str(card.verdict), *(text_of(card[key]) for key in COLUMNS)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", nargs="*", type=Path)
    parser.add_argument("--make", nargs="+", type=Path, default=[], metavar="CLIP", help="clips to make drafts of")
    parser.add_argument("--held-out", action="store_true", help="make from two thirds, hold against the last one")
    parser.add_argument("--work", type=Path, default=Path("runs"), help="folder for what is made")
    parser.add_argument("--json", type=Path, help="file for the cards")
    a = parser.parse_args()
    cards = {folder.stem: card_of(read_manifest(folder)) for folder in a.assets}
    for clip in a.make:
        a.work.mkdir(parents=True, exist_ok=True)
        folder, seconds = made(clip, a.work, a.held_out)
        cards[folder.stem] = card_against(folder, clip, start=seconds) if a.held_out else card_of(read_manifest(folder))
    print("\n".join(table(["asset", "verdict", *COLUMNS.values()], [row(*item) for item in cards.items()])))
    if a.json:
        plain = {name: {"none": c} if isinstance(c, str) else c.to_dict() for name, c in cards.items()}
        a.json.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
