"""One HTML file that plays an asset offline: frames, terrain, script and poster inside, nothing is fetched."""

from __future__ import annotations

import base64
import html
import importlib.resources
import json
import re
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import require
from fluidlift.io.atomic import atomic_write, plain
from fluidlift.io.export_gltf import encoded, once_per_corner
from fluidlift.io.frames import MovingMesh
from fluidlift.io.page_frames import FrameEncoder, Quantization
from fluidlift.numerics.mesh_normals import vertex_normals
from fluidlift.types import Gaussians, PinholeCamera, TriangleMesh

TEXTURE_MAX = 1024
"""px, longer side of the terrain's texture in the page"""
SIZE_ELEMENT = 80
"""bytes, about, of the element in the page that tells the page's size"""
BASE64 = 4 / 3
"""characters of the page per byte of its data"""

BODY = (0.75, 0.35, 0.2)
"""sRGB of bodies without colours of their own"""
SHARP = 0.8
"""cosine between a face and the mean of its neighbours beyond which an edge stays an edge"""

Solid = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""points, normals and colours per vertex, and faces"""


@dataclass(frozen=True)
class PageScene:
    """What a page shows beside the frames."""

    title: str
    camera: PinholeCamera
    """where the view starts"""
    target: tuple[float, float, float]
    """m: what the view turns about"""
    interval: float
    """s between the frames of the page"""
    numbers: tuple[int, ...]
    """of the frames, from 1001"""
    poster: np.ndarray
    """u8 [h,w,3] sRGB, shown until the first frame is there"""
    terrain: TriangleMesh | None = None
    terrain_opacity: float = 1.0
    """0 to 1; a vessel must not hide what it holds"""
    bodies: tuple[MovingMesh, ...] = ()
    """solids among the splats, in their poses at each frame of the page"""
    sun: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """direction towards the light on them, world"""
    warnings: tuple[str, ...] = ()
    """what was left out, for who looks at it"""
    facts: tuple[str, ...] = field(default_factory=tuple)
    """short ones, for the line under the title"""


def write_page(
    path: Path | str, frames: Iterable[tuple[Gaussians, np.ndarray]], held: Quantization, scene: PageScene
) -> tuple[Path, int]:
    """Write the page; frames (with ids int [n], each once) are taken one by one, and memory does not grow with them.

    Args:
        path: of the .html file.
        frames: as many as `scene.numbers`.
        held: range of all of them.
        scene: the rest.

    Returns:
        The path, and the size of the file in bytes.

    Raises:
        InputRejected: the disk does not take it.
        ValueError: another number of frames, or of poses.
    """
    counts = {len(body.positions) for body in scene.bodies}
    require(counts <= {len(scene.numbers)}, f"bodies with {counts} poses", f"{len(scene.numbers)}, one for each frame")
    encoder, count = FrameEncoder(held), 0
    solids = [_solid(body.mesh) for body in scene.bodies]
    script = f'"use strict";\n(() => {{\n{_part("shaders.js")}{_part("viewer.js")}}})();\n'
    with atomic_write(path) as file:
        file.write(_head(scene, held, solids).encode())
        terrain = _shown(scene.terrain)
        file.writelines(line.encode() for line in ([] if terrain is None else _terrain(terrain)))
        if solids:
            file.write(
                f'<script type="text/plain" id="solids">{_packed(p for s in solids for p in s)}</script>\n'.encode()
            )
        for gaussians, ids in frames:
            data = base64.b64encode(encoder.encode(gaussians, ids))
            file.write(b'<script type="text/plain" class="frame">' + data + b"</script>\n")
            count += 1
        require(count == len(scene.numbers), f"{count} frames", f"{len(scene.numbers)}")
        tail = f"<script>\n{script}</script>\n</body>\n</html>\n".encode()
        size = file.tell() + len(tail) + SIZE_ELEMENT
        told = json.dumps(f" · {size / 1e6:.1f} MB")
        file.write(f'<script type="application/json" id="size">{told}</script>\n'.encode() + tail)
    return Path(path), Path(path).stat().st_size


def _part(name: str) -> str:
    return (importlib.resources.files("fluidlift.io") / "page" / name).read_text(encoding="utf-8")


def _head(scene: PageScene, held: Quantization, solids: list[Solid]) -> str:
    terrain = _shown(scene.terrain)
    about: dict[str, Any] = {
        "range": held.to_dict(), "frames": len(scene.numbers), "numbers": scene.numbers, "interval": scene.interval,
        "camera": scene.camera.to_dict(), "target": scene.target, "extent": _extent(held, scene), "terrain": None,
        "sun": scene.sun, "bodies": [_posed(b, s) for b, s in zip(scene.bodies, solids, strict=True)],
    }  # fmt: skip
    if terrain is not None:
        about["terrain"] = {"vertices": len(once_per_corner(terrain)[0]), "faces": len(terrain.faces),
                            "textured": terrain.texture is not None, "opacity": scene.terrain_opacity}  # fmt: skip
    poster = base64.b64encode(encoded(scene.poster, "JPEG", quality=85)).decode()
    fields = {
        "TITLE": html.escape(scene.title),
        "POSTER_ALT": html.escape(f"first frame of {scene.title}"),
        "POSTER": f"data:image/jpeg;base64,{poster}",
        "FACTS": html.escape(" · ".join(scene.facts)),
        "WARNINGS": "".join(f'<p class="warn">{html.escape(text)}</p>' for text in scene.warnings),
        "PAGE": json.dumps(plain(about), allow_nan=False).replace("</", "<\\/"),
    }
    # all at once: a title that reads like a field stays a title
    return re.sub("@([A-Z_]+)@", lambda found: fields[found[1]], _part("page.html"))


def _extent(held: Quantization, scene: PageScene) -> float:
    """m, about the size of all that is seen."""
    reach = float(np.linalg.norm(np.subtract(scene.target, scene.camera.position)))
    terrain = _shown(scene.terrain)
    if terrain is None:
        return max(reach, 65535 * held.step)
    return max(reach, float(np.linalg.norm(np.ptp(terrain.vertices, axis=0))))


def _shown(terrain: TriangleMesh | None) -> TriangleMesh | None:
    return terrain if terrain is not None and len(terrain.faces) else None


def _terrain(mesh: TriangleMesh) -> list[str]:
    """The ground as the script reads it: points, texture coordinates or colours (float32), faces (uint32); deflated."""
    vertices, faces, uv = once_per_corner(mesh)
    points = np.asarray(mesh.vertices, np.float32)[vertices]
    if uv is not None and mesh.texture is not None:
        look = uv
    else:
        grey = np.full((len(mesh.vertices), 3), 0.55, np.float32)
        look = (grey if mesh.colors is None else np.clip(np.asarray(mesh.colors, np.float32), 0, 1))[vertices]
    data = _packed((points, look.astype("<f4"), faces.astype("<u4")))
    lines = [f'<script type="text/plain" id="terrain">{data}</script>\n']
    if mesh.texture is not None:
        picture = base64.b64encode(encoded(_smaller(mesh.texture), "JPEG", quality=85)).decode()
        lines.append(f'<script type="text/plain" id="texture">data:image/jpeg;base64,{picture}</script>\n')
    return lines


def _packed(parts: Iterable[np.ndarray]) -> str:
    """One after the other, deflated, as text."""
    return base64.b64encode(zlib.compress(b"".join(np.ascontiguousarray(p).tobytes() for p in parts), 9)).decode()


def _solid(mesh: TriangleMesh) -> Solid:
    """A body as the script reads it: points, normals, colours (float32) of three corners per face, and the faces.
    Normals turn smoothly over what bends little and leave edges sharp."""
    faces = np.asarray(mesh.faces, np.int64)
    corners = np.asarray(mesh.vertices, np.float64)[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, None]
    flat = flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-30)
    smooth = vertex_normals(mesh)[faces]
    normals = np.where((smooth * flat).sum(-1, keepdims=True) > SHARP, smooth, flat)
    colors = np.full((len(mesh.vertices), 3), BODY) if mesh.colors is None else np.clip(mesh.colors, 0, 1)
    points, normals, paint = (v.reshape(-1, 3).astype("<f4") for v in (corners, normals, np.asarray(colors)[faces]))
    return points, normals, paint, np.arange(3 * len(faces), dtype="<u4")


def _posed(body: MovingMesh, solid: Solid) -> dict[str, Any]:
    """Name, counts and poses (place in m, quaternion w x y z) of a body, as the script reads them."""
    poses = np.round(np.concatenate([body.positions, body.orientations], axis=1).astype(float), 6)
    return {"name": body.name, "vertices": len(solid[0]), "faces": len(solid[3]) // 3, "poses": poses.tolist()}


def _smaller(picture: np.ndarray) -> np.ndarray:
    from PIL import Image

    image = Image.fromarray(picture)
    image.thumbnail((TEXTURE_MAX, TEXTURE_MAX))
    return np.asarray(image)
