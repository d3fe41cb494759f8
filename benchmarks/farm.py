"""The engines of `fluidlift batch` beside each other: what they add to a shot, what kills do to them, the same bytes.

    python benchmarks/farm.py                            stand-ins for makes: overhead and kills, some three minutes
    python benchmarks/farm.py --bytes 40                 40 small made clips by both engines as well, half an hour
    python benchmarks/farm.py --record                   the figures into benchmarks/results

A stand-in takes half a second and computes nothing, so what is left of the time on the clock is the engine's and that
of starting Python. Kills come at random moments (`--seed`): two workers of Ray, then the driver, then the same batch
again. They come to the true makes by Ray as well, whose assets are then compared with those of local processes that
nobody disturbed.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from report import put

TESTS = Path(__file__).resolve().parent.parent / "tests"
AT_A_TIME = 2
SECONDS = 0.5
"""that a stand-in takes"""
STAND_IN = """
import json, pathlib, sys, time
from fluidlift.farm.guard import end_with_parent
end_with_parent()
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
def note(word):
    with (out.parent / (out.stem + "." + word)).open("a") as file:
        file.write("x")
note("begun")
time.sleep(SECONDS)
out.mkdir(exist_ok=True)
(out / "manifest.json").write_text(json.dumps({"of": out.stem}))
note("ended")
print("{}")
"""
TRUE = """
import pathlib, sys
from fluidlift.cli import main
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
def note(word):
    with (out.parent / (out.stem + "." + word)).open("a") as file:
        file.write("x")
note("begun")
code = main(sys.argv[1:])
if code in (0, 4):
    note("ended")
sys.exit(code)
"""
"""a make that notes when it begins and ends"""
TINY = ("shape.cells=12", "shape.refine_iterations=0", "motion.targets=1", "fit.max_seconds=600", "simulate.frames=2",
        "show.usd=false")  # fmt: skip
"""the smallest asset; the fit may take its time, because one that the clock ends depends on the machine"""


def batch(engine: str, folder: Path, shots: int, script: Path, clips: Path) -> list[float]:
    """Make all shots; when each ended, s after the beginning, the first entry being when the machines were ready."""
    from fluidlift.farm.engine import Engine, Limits
    from fluidlift.farm.local import LocalEngine
    from fluidlift.farm.ray_cluster import RayEngine
    from fluidlift.farm.shots import Shot

    folder.mkdir(exist_ok=True)
    options = {"set": list(TINY), "size": 2.0} if script.name == "true.py" else {}
    each = [Shot(clips / f"{k:03d}.mp4", f"{k:03d}", options) for k in range(shots)]
    made_by: Engine = LocalEngine(AT_A_TIME) if engine == "local" else RayEngine(cores=1, jobs=AT_A_TIME * 2)
    limits = Limits(tries=5, program=(sys.executable, str(script)), memory=1.5e9)
    began = time.monotonic()
    return [time.monotonic() - began for _ in made_by.shots(each, folder, limits, lambda text: None, lambda text: None)]


def overhead(ended: list[float]) -> dict[str, float]:
    """What an engine adds: before the first shot, and to each of the others, s."""
    rest = len(ended) - AT_A_TIME
    return {
        "start": round(ended[0] - SECONDS, 2),
        "overhead of a shot": round((ended[-1] - ended[AT_A_TIME - 1]) * AT_A_TIME / rest - SECONDS, 3),
    }


def killed(
    folder: Path, clips: Path, script: Path, shots: int, rng: random.Random, *, usual: float
) -> dict[str, float]:
    """Two workers and the driver are killed at random moments; what became of the shots once the batch ran again.

    Args:
        folder: for assets.
        clips: 000.mp4, 001.mp4, ...
        script: what makes one.
        shots: how many.
        rng: for the moments.
        usual: s that the batch takes, about.
    """
    folder.mkdir()
    words = [sys.executable, __file__, "--drive", str(folder), str(clips), str(script), str(shots)]
    driver = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    count("ended", folder, 1)
    lost = 0
    for _ in range(2):
        time.sleep(rng.uniform(0.0, 0.2 * usual))
        for lock in rng.sample(sorted(folder.glob("[0-9]*.lock")), k=min(8, len(list(folder.glob("[0-9]*.lock"))))):
            with suppress(OSError, ValueError, KeyError):
                pid = json.loads(lock.read_text())["pid"]
                if b"ray::" in Path(f"/proc/{pid}/cmdline").read_bytes() and pid != driver.pid:
                    os.kill(pid, signal.SIGKILL)
                    lost += 1
                    break
    time.sleep(rng.uniform(0.0, 0.2 * usual))
    driver.kill()
    driver.wait()
    states = [json.loads(p.read_text()) for p in folder.glob("*.state.json")]
    done = [state["name"] for state in states if state["outcome"].startswith("done")]
    before = {name: size(folder / f"{name}.begun") for name in done}
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    states = [json.loads(p.read_text()) for p in folder.glob("*.state.json")]
    return {
        "workers killed": lost,
        "finished before the driver was killed": len(done),
        "of these begun again": sum(size(folder / f"{name}.begun") != n for name, n in before.items()),
        "shots lost": shots - sum(s["outcome"].startswith("done") for s in states),
        "shots begun more than once": sum(size(p) > 1 for p in folder.glob("*.begun")),
        "shots ended more than once": sum(size(p) > 1 for p in folder.glob("*.ended")),
    }


def size(path: Path) -> int:
    """How often something was noted."""
    return path.stat().st_size if path.is_file() else 0


def count(word: str, folder: Path, least: int) -> None:
    """Wait until as many shots have noted a word."""
    until = time.monotonic() + 120.0
    while len(list(folder.glob(f"*.{word}"))) < least:
        if time.monotonic() > until:
            raise SystemExit("nothing was made in two minutes")
        time.sleep(0.05)


def bytes_apart(room: Path, clips: int, rng: random.Random) -> dict[str, float]:
    """True makes of small clips, each another one: those of Ray, with kills, beside those of local processes.

    How many assets differ, how long they took, and what became of the shots.
    """
    sys.path.insert(0, str(TESTS))
    from catalogue import digests, stream_pictures, write_clip

    place = room / "true"
    place.mkdir()
    for k in range(clips):
        pictures = stream_pictures(8 + k % 5, size=(96 + 16 * (k % 2), 64), step=2 + k % 3, seed=k)
        write_clip(place / f"{k:03d}.mp4", pictures)
    script = room / "true.py"
    script.write_text(TRUE)
    usual = batch("local", room / "local", clips, script, place)[-1]
    began = time.monotonic()
    found = killed(room / "ray", place, script, clips, rng, usual=usual)
    took = {"local": usual, "ray with kills": time.monotonic() - began}
    names = [f"{k:03d}.fluid" for k in range(clips)]
    if bad := [n for n in names if not (room / "local" / n / "manifest.json").is_file()]:
        raise SystemExit(f"not made, by local processes that nobody disturbed: {', '.join(bad)}")
    return {
        "made": sum((room / "ray" / n / "manifest.json").is_file() for n in names),
        "assets whose bytes differ": sum(digests(room / "local" / n) != digests(room / "ray" / n) for n in names),
        **{f"time, {engine}": round(seconds, 1) for engine, seconds in took.items()}, **found,
    }  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Measure, and print or record."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--shots", type=int, default=40)
    parser.add_argument("--bytes", type=int, default=0, metavar="CLIPS")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--drive", nargs=4, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.drive:
        folder, clips, script, shots = args.drive
        batch("ray", Path(folder), int(shots), Path(script), Path(clips))
        return 0
    found: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name:
        room = Path(name)
        script = room / "stand_in.py"
        script.write_text(STAND_IN.replace("SECONDS", str(SECONDS)))
        (room / "clips").mkdir()
        for k in range(args.shots):
            (room / "clips" / f"{k:03d}.mp4").write_text(f"film {k}")
        for engine, subject in (("local", "local processes"), ("ray", "Ray on one machine")):
            ended = batch(engine, room / f"{engine}_fast", args.shots, script, room / "clips")
            found[f"{subject}, {AT_A_TIME} at a time"] = overhead(ended)
        rng = random.Random(args.seed)
        found["Ray, two workers and the driver killed"] = killed(
            room / "killed", room / "clips", script, args.shots, rng, usual=args.shots * SECONDS / AT_A_TIME
        )
        if args.bytes:
            found[f"{args.bytes} made clips by both engines"] = bytes_apart(room, args.bytes, rng)
    print(json.dumps(found, indent=1))
    if args.record:
        recorded(
            found, f"python benchmarks/farm.py --shots {args.shots} --bytes {args.bytes} --seed {args.seed} --record"
        )
    return 0


def recorded(found: dict[str, dict[str, float]], command: str) -> None:
    """Put what was measured into the results, and what Ray adds to a shot onto their page."""
    of_all = {
        "command": command, "date": datetime.date.today().isoformat(),
        "machine": f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the end, {platform.system()}, "
                   f"Python {platform.python_version()}",
    }  # fmt: skip
    plain = ("made", "workers killed", "finished before the driver was killed")
    rows = [{"subject": s, "figure": f, "value": v, "unit": "s" if f.startswith(("start", "time", "overhead")) else "",
             "better": "" if f in plain else "less"} for s, row in found.items() for f, v in row.items()]  # fmt: skip
    shown = [r | {"shown": True} for r in rows if r["figure"] == "overhead of a shot" and "Ray" in r["subject"]]
    put("farm", rows, **of_all)
    put("cost", shown, **of_all)


if __name__ == "__main__":
    raise SystemExit(main())
