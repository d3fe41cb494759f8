"""Pack the extension: python blender/pack.py [FOLDER] writes FOLDER/fluidlift_asset-VERSION.zip (default: dist).

The same files give the same bytes, on any day and machine. Needs nothing but Python 3.11.
"""

from __future__ import annotations

import argparse
import tomllib
import zipfile
from pathlib import Path

SOURCE = Path(__file__).with_name("fluidlift_asset")
EARLIEST = (1980, 1, 1, 0, 0, 0)
"""that a zip can hold; the files' own times would make every zip another one"""
SUFFIXES = (".py", ".toml")


def pack(into: Path) -> Path:
    """Write the zip; its path. Blender 4.2 and newer wants the manifest inside one folder or at the top, older versions
    want the folder."""
    version = tomllib.loads((SOURCE / "blender_manifest.toml").read_text(encoding="utf-8"))["version"]
    into.mkdir(parents=True, exist_ok=True)
    out = into / f"{SOURCE.name}-{version}.zip"
    with zipfile.ZipFile(out, "w") as archive:
        for file in sorted(p for p in SOURCE.iterdir() if p.suffix in SUFFIXES):
            entry = zipfile.ZipInfo(f"{SOURCE.name}/{file.name}", EARLIEST)
            entry.external_attr, entry.create_system = 0o644 << 16, 3
            # stored, not deflated: compressors differ between versions of zlib
            archive.writestr(entry, file.read_bytes(), zipfile.ZIP_STORED)
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).resolve().parents[1] / "dist")
    print(pack(parser.parse_args().folder))
