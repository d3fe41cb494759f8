"""Files for the web, read by tools that are not ours: Khronos' gltf-validator and PlayCanvas' splat-transform.

    python benchmarks/check_web_formats.py out.fluid

Needs Node (20 or later) and npm, which fetches both tools (Apache-2.0 and MIT) into a temporary folder. Exits with 1
when the validator finds a fault, or what splat-transform reads differs from what was written.

The validator of 2025 does not know KHR_gaussian_splatting (ratified in 2026): it calls the attribute names of the
extension invalid, one error for each, and those are counted apart; nothing else is forgiven.
"""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from fluidlift.export import ExportRequest, export_asset
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.ply import AXES, read_splats, write_gaussians
from fluidlift.io.spz import fractional_bits, read_spz, write_spz
from fluidlift.look.rasterize import render
from fluidlift.types import Gaussians, PinholeCamera, Similarity3

TOOLS = ("gltf-validator@2.0.0-dev.3.10", "@playcanvas/splat-transform@2.7.1")
VALIDATE = """
const {validateBytes} = require('gltf-validator'), fs = require('fs');
validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])), {maxIssues: 0})
  .then(r => console.log(JSON.stringify(r.issues.messages)));
"""
HALF_TURN = np.diag([-1.0, 1.0, -1.0])
"""about the vertical: splat-transform faces captures the other way when it writes glTF; they stay upright"""


def installed(folder: Path) -> Path:
    """The tools, fetched."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        sys.exit("needs Node and npm")
    (folder / "package.json").write_text("{}")
    subprocess.run([npm, "install", "--silent", "--no-audit", "--no-fund", *TOOLS], cwd=folder, check=True)
    return folder


def issues(tools: Path, path: Path) -> tuple[list[str], int, int]:
    """(faults, errors for names of the extension, notes) of a .glb."""
    run = subprocess.run(["node", "-e", VALIDATE, str(path)], cwd=tools, capture_output=True, text=True, check=True)
    found = json.loads(run.stdout)
    unknown = [m for m in found if m["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE"]
    named = [m for m in unknown if "KHR_gaussian_splatting:" in m["pointer"]]
    faults = [f"{m['code']} {m['pointer']}: {m['message']}" for m in found if m["severity"] < 2 and m not in named]
    return faults, len(named), len([m for m in found if m["severity"] >= 2])


def transformed(tools: Path, source: Path, target: Path, *options: str) -> Path:
    """A file that splat-transform has made of another."""
    tool = tools / "node_modules" / ".bin" / "splat-transform"
    subprocess.run([str(tool), "-q", "-w", str(source), str(target), *options], check=True, capture_output=True)
    return target


def splats_in(path: Path) -> Gaussians:
    """The Gaussians of a .glb as they stand in it."""
    data = path.read_bytes()
    (size,) = struct.unpack("<I", data[12:16])
    document, body = json.loads(data[20 : 20 + size]), data[28 + size :]
    kinds, widths = {5126: "<f4", 5121: "u1"}, {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
    part = {}
    for name, i in document["meshes"][0]["primitives"][0]["attributes"].items():
        a = document["accessors"][i]
        view, width = document["bufferViews"][a["bufferView"]], widths[a["type"]]
        values = np.frombuffer(body, kinds[a["componentType"]], a["count"] * width, view["byteOffset"])
        part[name.rpartition(":")[2]] = values.reshape(-1, width)
    sh = np.stack([part[k] for k in sorted(part) if k.startswith("SH_")], axis=1)
    quats = part["ROTATION"][:, [3, 0, 1, 2]]
    return Gaussians(part["POSITION"], quats, part["SCALE"], part["OPACITY"][:, 0], sh)


def compared(name: str, back: Gaussians, own: Gaussians, camera: PinholeCamera) -> dict:
    """How far splats are from those that they should be; the order is the same."""
    error = render(back, camera).image - render(own, camera).image
    covariance = own.covariances()
    return {
        "file": name, "splats": len(back),
        "position_mm": round(1e3 * float(np.abs(back.means - own.means).max()), 4),
        "shape": round(float(np.abs(back.covariances() - covariance).max() / np.abs(covariance).max()), 5),
        "opacity": round(float(np.abs(back.opacities - own.opacities).max()), 5),
        "colour": round(float(np.abs(back.rgb - own.rgb).max()), 5),
        "psnr_db": round(float(-10 * np.log10(max((error**2).mean(), 1e-12))), 1),
    }  # fmt: skip


def main(asset: Path) -> int:
    """Check the middle frame of an asset in every format."""
    from fluidlift.io.asset_folder import load_asset
    from fluidlift.io.export_gltf import write_gltf

    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        tools = installed(work)
        whole = export_asset(asset, work / "gltf", ExportRequest("gltf"))
        k = whole.facts["first"] - FIRST_FRAME
        numbers = (FIRST_FRAME + k, FIRST_FRAME + k)
        export_asset(asset, work / "spz", ExportRequest("spz", frames=numbers))
        export_asset(asset, work / "ply", ExportRequest("splats", frames=numbers))
        camera, terrain = load_asset(asset).camera, load_asset(asset).terrain.mesh
        own = read_splats(next((work / "ply").glob("????.ply"))).gaussians
        valid = []
        glbs = [*sorted((work / "gltf").iterdir()), asset / "rest" / "terrain.glb"]
        if len(terrain.faces):
            glbs.append(write_gltf(work / "mesh_alone.glb", meshes={"terrain": terrain}))
        for path in (p for p in glbs if p.is_file()):
            faults, named, notes = issues(tools, path)
            valid.append({"file": path.name, "faults": faults, "extension_names": named, "notes": notes})
        rows = []
        spz = next((work / "spz").iterdir())
        for version in (2, 3):
            path = write_spz(work / f"v{version}.spz", own, version=version) if version == 2 else spz
            theirs = transformed(tools, path, work / f"v{version}.ply")
            back = read_splats(theirs, axes="y_down").gaussians
            rows.append(compared(f"SPZ {version}, read by splat-transform", back, own, camera))
        y_down = work / "y_down.ply"
        write_gaussians(y_down, own, axes="y_down")
        theirs = transformed(tools, y_down, work / "theirs.glb")
        world = Similarity3(rotation=AXES["y_up"].T @ HALF_TURN)
        rows.append(compared("PLY, read by splat-transform, as GLB", splats_in(theirs).transformed(world), own, camera))
        ours = splats_in(work / "gltf" / "hero.glb").transformed(Similarity3(rotation=AXES["y_up"].T))
        rows.append(compared("GLB, ours", ours, own, camera))
        theirs = transformed(tools, y_down, work / "theirs.spz", "--spz-version", "3")
        rows.append(compared("SPZ of splat-transform, read by us", read_spz(theirs), own, camera))
        bits = fractional_bits(own.means)
    print(json.dumps({"tools": TOOLS, "gltf": valid, "splats": rows, "spz_step_mm": 1e3 * 2.0**-bits}, indent=1))
    wrong = [v for v in valid if v["faults"]] + [r for r in rows if r["psnr_db"] < 40 or r["splats"] != len(own)]
    return 1 if wrong else 0


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    sys.exit(main(Path(sys.argv[1])))
