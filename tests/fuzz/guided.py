"""`python -m tests.fuzz --guided SECONDS TARGET`: inputs that Atheris leads to new branches of a reader, where it is
installed (`pip install atheris`). It is not among the packages that development needs: it has no wheels for every
system. The first input that ends in something else than a refusal ends the run, and is kept.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import fluidlift
from fluidlift.io.confined import reading_here

from .trial import Folder, Watched


def run_guided(name: str, seconds: int, keep: Path) -> None:
    """Does not return: Atheris ends the process, with exit code 0 where nothing was found.

    Args:
        name: of a target.
        seconds: how long.
        keep: folder for what is found.

    Raises:
        SystemExit: Atheris is not installed.
    """
    try:
        import atheris
    except ImportError:
        raise SystemExit("Atheris is not installed: pip install atheris") from None
    from .targets import TARGETS

    target, place = TARGETS[name], Path(tempfile.mkdtemp(prefix="fuzz"))
    seeds, folder, watched = target.seeds(), Folder(target, place / "in"), Watched()
    sound = place / "sound"
    sound.mkdir()
    for k, seed in enumerate(seeds):
        (sound / str(k)).write_bytes(bytes([k]) + seed.data)
        with reading_here():  # it imports what is to be led through
            folder.read(seed.pack(seed.data))
    for module in [m for n, m in sys.modules.items() if n.startswith(f"{fluidlift.__name__}.io.")]:
        for function in vars(module).values():
            if getattr(function, "__module__", "") == module.__name__ and hasattr(function, "__code__"):
                atheris.instrument_func(function)
    keep.mkdir(parents=True, exist_ok=True)

    def one(data: bytes) -> None:
        seed = seeds[data[0] % len(seeds)] if data else seeds[0]
        with reading_here(), watched.only(folder.place):
            folder.read(seed.pack(data[1:]))
        if watched.found:
            raise AssertionError(f"opened {watched.found}")

    atheris.Setup(
        [name, f"-max_total_time={seconds}", "-max_len=65536", "-timeout=20", "-rss_limit_mb=2048",
         f"-artifact_prefix={keep}/{name}.", str(sound)], one,
    )  # fmt: skip
    atheris.Fuzz()


if __name__ == "__main__":
    run_guided(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
