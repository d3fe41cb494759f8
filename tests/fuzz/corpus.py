"""Sound files of every kind that is read, made on the spot; and what is inside of packed ones, packed again."""

from __future__ import annotations

import gzip
import io
import json
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from catalogue import write_clip
from small_asset import random_gaussians, small_asset, small_mesh

from fluidlift.io.asset_folder import save_asset
from fluidlift.io.checkpoint import Checkpoint, write_checkpoint
from fluidlift.io.export_mesh import write_glb
from fluidlift.io.exr_write import write_channels
from fluidlift.io.flow_files import write_flow
from fluidlift.io.packed_splats import COLUMNS, write_packed
from fluidlift.io.ply import write_gaussians, write_mesh
from fluidlift.io.scene import SCENE_TEMPLATE
from fluidlift.io.spz import write_spz


class Seed(NamedTuple):
    """What is changed, and how a file is made of it."""

    data: bytes
    pack: Callable[[bytes], bytes] = bytes


def _written(write: Callable[[Path], object], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def _picture(size: tuple[int, int], channels: int, dtype: type = np.uint8) -> np.ndarray:
    h, w = size[1], size[0]
    rng = np.random.default_rng(0)
    return rng.integers(0, np.iinfo(dtype).max, (h, w, channels)).astype(dtype)


@cache
def pictures() -> list[Seed]:
    """PNG, JPEG, TIFF, WebP, BMP of several depths and layouts."""
    small, deep = _picture((48, 32), 3), _picture((48, 32), 3, np.uint16)
    made = [(".png", small), (".png", deep), (".png", _picture((48, 32), 4)), (".jpg", small), (".tif", small),
            (".tif", deep[..., 0]), (".tif", small.astype(np.float32)), (".webp", small), (".bmp", small)]  # fmt: skip
    return [Seed(cv2.imencode(suffix, picture)[1].tobytes()) for suffix, picture in made]


@cache
def exr() -> list[Seed]:
    """OpenEXR of one and of three channels."""
    light = np.random.default_rng(1).uniform(1, 2, (32, 64)).astype(np.float32)
    sets = [{"Z": light}, {"R": light, "G": light, "B": light}, {"forward.u": light, "forward.v": light}]
    return [Seed(_written(lambda p, c=c: write_channels(p, c), "a.exr")) for c in sets]


@cache
def radiance() -> list[Seed]:
    """Radiance .hdr, plain and in run lengths."""
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n"
    lines = b"".join(bytes((2, 2, 0, 16)) + bytes((128 + 16, 90)) * 4 for _ in range(8))
    return [Seed(head + bytes(range(256)) * 2), Seed(head + lines)]


def npz_seeds(data: bytes) -> list[Seed]:
    """An npz as it is, and each of its arrays by itself, in the npz again."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}

    def packed(name: str) -> Callable[[bytes], bytes]:
        def pack(inner: bytes) -> bytes:
            out = io.BytesIO()
            with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
                for other, content in members.items():
                    archive.writestr(other, inner if other == name else content)
            return out.getvalue()

        return pack

    return [Seed(data), *(Seed(content, packed(name)) for name, content in members.items())]


def npz(**arrays: np.ndarray) -> bytes:
    """An npz of some arrays."""
    out = io.BytesIO()
    np.savez_compressed(out, allow_pickle=False, **arrays)
    return out.getvalue()


@cache
def depths() -> list[Seed]:
    """Depth as .npy and .npz."""
    depth = np.linspace(1, 2, 48 * 32, dtype=np.float32).reshape(32, 48)
    plain = io.BytesIO()
    np.save(plain, np.stack([depth, depth]))
    return [Seed(plain.getvalue()), *npz_seeds(npz(depth=depth))]


@cache
def flows() -> list[Seed]:
    """Optical flow as .flo, .npy, .npz, .exr and KITTI's .png."""
    moved = np.random.default_rng(2).normal(size=(32, 48, 2)).astype(np.float32)
    known = np.ones((32, 48), np.float32)

    def write(kind: str) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            return write_flow(folder, 0, moved, known, kind).read_bytes()

    kitti = np.dstack([np.ones((32, 48)), 64 * moved[..., 1] + 2**15, 64 * moved[..., 0] + 2**15]).astype(np.uint16)
    plain = io.BytesIO()
    np.save(plain, moved[None])
    return [Seed(write("flo")), Seed(write("exr")), *npz_seeds(write("npz")), Seed(plain.getvalue()),
            Seed(cv2.imencode(".png", kitti)[1].tobytes())]  # fmt: skip


OBJ = b"""mtllib a.mtl
v 0 0 0
v 1 0 0 1 0 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0
vt 0.5 1
usemtl stone
f 1/1 3/2 2/3
f 1/1 2/2 4/3
usemtl moss
f -4 -1 -2
f 2/1/1 3/2/2 4/3/3
"""
MTL = b"newmtl stone\nKd 0.5 0.5 0.5\nmap_Kd a.png\nnewmtl moss\nKd 1 0 0\n"


def glb_parts(data: bytes) -> tuple[dict, bytes]:
    """The scene and the binary chunk, with its head, of a GLB."""
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[20 + length :]


def glb_file(text: bytes, binary: bytes) -> bytes:
    """A GLB of the JSON of its scene and a binary chunk."""
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(binary), len(text), 0x4E4F534A)
    return head + text + binary


def scene_with_picture(side: int = 16) -> tuple[dict, bytes]:
    """The scene of a triangle with a picture and colours of its vertices, and its binary data."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    corners = np.array([0, 1, 2], "<u2").tobytes() + b"\0\0"
    uv = np.array([[0, 0], [1, 0], [0, 1]], "<f4").tobytes()
    picture = cv2.imencode(".png", np.full((side, side, 3), 90, np.uint8))[1].tobytes()
    views, binary = [], b""
    for part in (points, corners, uv, picture):
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(part)})
        binary += part + b"\0" * (-len(part) % 4)
    scene = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [0, 0, 1], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2, "COLOR_0": 0}, "indices": 1,
                                    "material": 0, "mode": 4}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "byteOffset": 0},
                      {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
                      {"bufferView": 2, "componentType": 5126, "count": 3, "type": "VEC2"}],
        "bufferViews": views, "buffers": [{"byteLength": len(binary)}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 0.5, 1, 1]}}],
        "textures": [{"source": 0}], "images": [{"bufferView": 3, "mimeType": "image/png"}],
    }  # fmt: skip
    return scene, struct.pack("<II", len(binary), 0x004E4942) + binary


@cache
def glb() -> list[Seed]:
    """Binary glTF: whole, and its JSON with the binary chunk behind it."""
    plain = _written(lambda p: write_glb(p, small_mesh()), "a.glb")
    scene, binary = scene_with_picture()
    text = json.dumps(scene).encode()
    return [Seed(plain), Seed(text, lambda t: glb_file(t, binary)), Seed(glb_file(text, binary))]


@cache
def mesh_plys() -> list[Seed]:
    """A mesh as PLY."""
    return [Seed(_written(lambda p: write_mesh(p, small_mesh()), "a.ply"))]


@cache
def splats() -> list[Seed]:
    """Gaussians as PLY."""
    g = random_gaussians(30)
    moving = np.zeros((30, 3), np.float32)
    return [Seed(_written(lambda p: write_gaussians(p, g, ids=np.arange(30), velocities=moving), "a.ply"))]


@cache
def packed() -> list[Seed]:
    """A packed frame: as it is, its head and records, and the lowest bytes of each column in a stream again."""
    g, head = random_gaussians(300), 12 + 28 * len(COLUMNS)
    moving = np.random.default_rng(3).normal(size=(300, 3)).astype(np.float32)
    data = _written(lambda p: write_packed(p, g, ids=np.arange(300), velocities=moving), "a.flsp")
    records = [list(struct.unpack_from("<di4I", data, 12 + 28 * k)) for k in range(len(COLUMNS))]
    starts = head + np.cumsum([0, *(sum(r[2:]) for r in records)])

    def inside(k: int) -> Seed:
        """The first plane of a column."""
        start, size = int(starts[k]), records[k][2]

        def pack(plane: bytes) -> bytes:
            stream = zlib.compress(plane, 1)
            told = [*records[:k], [*records[k][:2], len(stream), *records[k][3:]], *records[k + 1 :]]
            return b"".join([data[:12], *(struct.pack("<di4I", *r) for r in told), data[head:start], stream,
                             data[start + size :]])  # fmt: skip

        kept = data[start : start + size]
        try:
            return Seed(zlib.decompress(kept), pack)
        except zlib.error:  # one that is kept as it is
            return Seed(kept, pack)

    whole = [Seed(data), Seed(data[:head], lambda h: h + data[head:])]
    return whole + [inside(k) for k in range(len(COLUMNS)) if records[k][2]]


@cache
def spz() -> list[Seed]:
    """SPZ as it is, and what is in the gzip stream."""
    data = _written(lambda p: write_spz(p, random_gaussians(30)), "a.spz")
    return [Seed(data), Seed(gzip.decompress(data), lambda d: gzip.compress(d, 1))]


@cache
def checkpoints() -> list[Seed]:
    """A checkpoint, its arrays, and its header as JSON."""
    held = Checkpoint(2, {"grid": "ab"}, {"x": np.ones((4, 3), np.float32)}, {"volume": np.ones(2)})
    data = _written(lambda p: write_checkpoint(p, held), "a.npz")
    seeds = npz_seeds(data)
    with np.load(io.BytesIO(data)) as found:
        arrays = {name: found[name] for name in found.files}
    header = bytes(arrays.pop("header"))
    return [*seeds, Seed(header, lambda h: npz(header=np.frombuffer(h, np.uint8), **arrays))]


@cache
def videos() -> list[Seed]:
    """A clip as MP4 and as GIF."""
    frames = np.stack([np.roll(_picture((48, 32), 3), t, axis=1) for t in range(6)])
    gif = io.BytesIO()
    from PIL import Image

    first, *rest = (Image.fromarray(f) for f in frames)
    first.save(gif, "GIF", save_all=True, append_images=rest)
    return [Seed(_written(lambda p: write_clip(p, frames), "a.mp4")), Seed(gif.getvalue())]


USDA = b"""#usda 1.0
(
    defaultPrim = "Fluid"
    metersPerUnit = 1
    upAxis = "Z"
    startTimeCode = 1001
    endTimeCode = 1002
    timeCodesPerSecond = 24
)
def Xform "Fluid" (kind = "component")
{
    def ParticleField3DGaussianSplat "Splats"
    {
        point3f[] positions = [(0, 0, 0), (1, 0, 0)]
        quatf[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0)]
        float3[] scales = [(1, 1, 1), (1, 1, 1)]
        float[] opacities = [0.5, 0.5]
        uniform int radiance:sphericalHarmonicsDegree = 0
        float3[] radiance:sphericalHarmonicsCoefficients = [(0, 0, 0), (0, 0, 0)]
    }
    def Points "Points"
    {
        point3f[] points = [(0, 0, 0), (1, 0, 0)]
        int64[] ids = [1, 2]
        vector3f[] velocities = [(0, 0, 0), (0, 0, 0)]
        float[] widths = [1, 1]
    }
    def "Other" (references = @./other.usda@</Fluid>)
    {
    }
}
"""

SCENE = b"""parameters:
  density: 1000
  gravity: [0, 0, -9.81]
obstacles:
  - {shape: sphere, position: [0, 0, 0.2], radius: 0.1}
  - {shape: box, position: [0, 0, 0.3], size: [0.2, 0.2, 0.1], motion: free, density: 400}
  - {mesh: a.obj, rotation: [0, 0, 90], scale: 0.1, motion: animated, keyframes: [{time: 0, position: [0, 0, 0]},
     {time: 1, position: [0, 0, 1]}]}
emitters:
  - {shape: cylinder, radius: 0.05, height: 0.02, position: [0, 0, 1], velocity: [0, 0, -1], end: 2.5}
terrain:
  - {move: [0, 0, 0.1]}
  - {twist: 20}
inflow:
  factor: 1.5
  keyframes: [{time: 0, factor: 1}, {time: 1, factor: 2}]
look:
  style: surface
  material: honey
  tint: [1, 0.5, 0]
duration: 4.0
extend_downstream: 2.0
loop: true
"""
SETTINGS = b"preset: draft\nread: {max_size: 320, start: 0.5}\nfit:\n  max_seconds: 1e2\n  free: [a, b]\nseed: 3\n"
SHOTS = b"- a.mp4\n- clip: b.mp4\n  name: two\n  size: 4\n  set: [fit.max_seconds=3, read.max_size=320]\n"
TEMPLATE = SCENE_TEMPLATE.encode()


@cache
def asset_parts() -> dict[str, bytes]:
    """Every file of a small asset, by its name in the folder."""
    with tempfile.TemporaryDirectory() as folder:
        save_asset(folder, small_asset())
        files = [p for p in Path(folder).rglob("*") if p.is_file()]
        return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


def lay_out(folder: Path, files: dict[str, bytes]) -> None:
    """Write files into a folder."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
