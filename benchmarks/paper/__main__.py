"""Writes docs/paper.md: each figure and table of the paper in words, and ours under it, with pictures and figures.

    python -m benchmarks.paper                       all that is not there yet, then the page
    python -m benchmarks.paper --only flow planar    some steps
    python -m benchmarks.paper --again flow          a step whose pictures are there already
    python -m benchmarks.paper --page                the text alone

Assets and cases lie in a work folder (`--work`) and are made once. A step that fails is told and does not stop the
others. Pictures are of the demo clip and of made scenes alone.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from benchmarks.paper import body, fields, gallery, numbers, velocity
from benchmarks.paper.page import PAGE, page
from benchmarks.paper.sections import SECTIONS
from benchmarks.paper.workshop import Workshop

STEPS: dict[str, Callable[[Workshop], None]] = {
    "edits": gallery.edits,
    "teaser": gallery.teaser,
    "refined": body.refinement,
    "filled": body.filling,
    "flow": velocity.correction,
    "layer": velocity.boundary_layer,
    "fields": fields.four_fields,
    "parameters": numbers.parameters,
    "planar": velocity.planar,
    "resimulated": gallery.resimulated,
    "study": gallery.per_frame,
    "starts": fields.arbitrary_starts,
    "pressure": numbers.pressure,
    "preset": numbers.preset,
    "examples": gallery.examples,
    "time": numbers.run_time,
}
"""in the order in which they run"""


def run(shop: Workshop, name: str, *, again: bool) -> bool:
    """One step, unless it is done; False where it failed."""
    done = shop.folder / "done" / name
    if done.is_file() and not again:
        return True
    began = time.perf_counter()
    try:
        STEPS[name](shop)
        shop.flush(f"python -m benchmarks.paper --only {name}")
    except Exception:
        shop.records.clear()
        print(f"{name} failed:\n{traceback.format_exc()}", file=sys.stderr, flush=True)
        return False
    done.parent.mkdir(parents=True, exist_ok=True)
    done.touch()
    print(f"{name}: {time.perf_counter() - began:.0f} s", flush=True)
    return True


def main() -> int:
    """Steps, then the page; 1 where a step failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path(".assets/paper"), help="default: .assets/paper")
    parser.add_argument("--only", nargs="+", choices=list(STEPS), default=list(STEPS))
    parser.add_argument("--again", nargs="+", choices=list(STEPS), default=[])
    parser.add_argument("--page", action="store_true", help="write the text from what is there")
    told = parser.parse_args()
    shop, failed = Workshop(told.work), []
    if not told.page:
        names = told.again if told.again and len(told.only) == len(STEPS) else told.only
        failed = [name for name in names if not run(shop, name, again=name in told.again)]
    PAGE.write_text(page(SECTIONS), encoding="utf-8")
    print(f"{PAGE.name} written" + (f"; failed: {', '.join(failed)}" if failed else ""))
    return int(bool(failed))


if __name__ == "__main__":
    raise SystemExit(main())
