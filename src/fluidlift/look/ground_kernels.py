"""The compiled loops of `ground_picture` (Numba): pixels of a mesh, shadow maps, filling in between coarse pixels."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from fluidlift.numerics.sharing import shared

TAPS = 12
"""places of the map that are looked at for a soft edge"""
MARGIN = 0.3
"""pixels of the light's picture by which a surface may lie behind itself"""
STEEPEST = 0.05
"""cosine of the light beyond which a surface is taken to be no steeper"""
TILE = 8
"""px of a shadow map whose nearest depth is kept: where it lies behind a point, nothing shades it"""
_TURN = math.pi * (3.0 - math.sqrt(5.0))


def tap_places(reach: float) -> np.ndarray:
    """Places [taps,2] (px) around a point that are looked at for a soft edge of half width `reach` (px)."""
    if reach <= 0.0:
        return np.zeros((1, 2))
    t = np.arange(TAPS)
    away = reach * np.sqrt((t + 0.5) / TAPS)
    return np.stack([away * np.cos(_TURN * t), away * np.sin(_TURN * t)], axis=-1)


@nb.njit(cache=True)
def _texel(texture, u, v, k):
    """Bilinear; values lie in the middles of the texels, and the rim goes on (see `numerics.textures`)."""
    h, w = texture.shape[0], texture.shape[1]
    x, y = min(max(u * w - 0.5, 0.0), w - 1.0), min(max(v * h - 0.5, 0.0), h - 1.0)
    j, i = min(int(x), max(w - 2, 0)), min(int(y), max(h - 2, 0))
    a, b = x - j, y - i
    j1, i1 = min(j + 1, w - 1), min(i + 1, h - 1)
    upper = (1.0 - a) * texture[i, j, k] + a * texture[i, j1, k]
    lower = (1.0 - a) * texture[i1, j, k] + a * texture[i1, j1, k]
    return (1.0 - b) * upper + b * lower


@shared(lambda face, *_: (0, face.shape[0]), error_model="numpy")
def paint(
    begin,
    end,
    face,
    share,
    found,
    vertices,
    faces,
    smooth,
    colors,
    uv,
    texture,
    textured,
    view,
    crease,
    depth,
    albedo,
    normal,
):
    """Depth, albedo and normal (world, towards the viewer) of a mesh's pixels that are nearer than what is there.

    view: fx, fy, cx, cy, then the camera's axes in the world (rotation, row by row). crease: cosine between a face and
    its smooth normal below which the face's own is taken.
    """
    for i in range(begin, end):
        for j in range(face.shape[1]):
            f = face[i, j]
            if f < 0 or (depth[i, j] > 0 and depth[i, j] <= found[i, j]):
                continue
            depth[i, j] = found[i, j]
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            s, t, r = share[i, j, 0], share[i, j, 1], share[i, j, 2]
            if textured:
                u = s * uv[f, 0, 0] + t * uv[f, 1, 0] + r * uv[f, 2, 0]
                v = s * uv[f, 0, 1] + t * uv[f, 1, 1] + r * uv[f, 2, 1]
            for k in range(3):
                if textured:
                    albedo[i, j, k] = _texel(texture, u, v, k)
                else:
                    albedo[i, j, k] = s * colors[a, k] + t * colors[b, k] + r * colors[c, k]
            px, py, pz = (
                vertices[b, 0] - vertices[a, 0],
                vertices[b, 1] - vertices[a, 1],
                vertices[b, 2] - vertices[a, 2],
            )
            qx, qy, qz = (
                vertices[c, 0] - vertices[a, 0],
                vertices[c, 1] - vertices[a, 1],
                vertices[c, 2] - vertices[a, 2],
            )
            x, y, z = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
            length = max(math.sqrt(x * x + y * y + z * z), 1e-30)
            x, y, z = x / length, y / length, z / length
            nx = s * smooth[a, 0] + t * smooth[b, 0] + r * smooth[c, 0]
            ny = s * smooth[a, 1] + t * smooth[b, 1] + r * smooth[c, 1]
            nz = s * smooth[a, 2] + t * smooth[b, 2] + r * smooth[c, 2]
            length = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
            nx, ny, nz = nx / length, ny / length, nz / length
            if not nx * x + ny * y + nz * z > crease:
                nx, ny, nz = x, y, z
            e, g = (j + 0.5 - view[2]) / view[0], (i + 0.5 - view[3]) / view[1]
            facing = 0.0
            for k in range(3):
                along = view[4 + k] * e + view[7 + k] * g + view[10 + k]
                facing += along * (x if k == 0 else (y if k == 1 else z))
            sign = -1.0 if facing > 0 else 1.0
            normal[i, j, 0], normal[i, j, 1], normal[i, j, 2] = sign * nx, sign * ny, sign * nz


@shared(lambda pixels, *_: (0, pixels.shape[0]))
def world_points(begin, end, pixels, depth, view, eye, points):
    """Points [n,3] (m) seen at pixels (row, column) of a depth picture; `view` as of `paint`."""
    for n in range(begin, end):
        i, j = pixels[n, 0], pixels[n, 1]
        z = depth[i, j]
        x, y = (j + 0.5 - view[2]) / view[0], (i + 0.5 - view[3]) / view[1]
        for k in range(3):
            points[n, k] = eye[k] + z * (view[4 + k] * x + view[7 + k] * y + view[10 + k])


@shared(lambda points, *_: (0, points.shape[0]), error_model="numpy")
def shadowed(begin, end, points, normals, sun, toward, bias, solid, first, left, tiles, places, reach, lit):
    """Share [n,3] of light from one direction at points, by the light's own picture of the scene.

    sun: f, cx, cy, rotation (row by row) and translation of the light's camera. bias: m, width of its pixels:
    points are lifted off their surface by a part of that. solid: depth of what lets
    nothing pass (0: none). first: depth at which the liquid begins (0: none), left [h,w,3]: share behind it. tiles:
    nearest depth of both in and around each tile. places: of `tap_places`; reach: px, half width of edges; 0: the four
    texels around, weighted, which is the least that does not show the texels.
    """
    h, w = solid.shape
    for n in range(begin, end):
        cos = normals[n, 0] * toward[0] + normals[n, 1] * toward[1] + normals[n, 2] * toward[2]
        if cos <= 0.0:
            lit[n, 0], lit[n, 1], lit[n, 2] = 0.0, 0.0, 0.0
            continue
        lift = MARGIN * bias
        x, y = points[n, 0] + lift * normals[n, 0], points[n, 1] + lift * normals[n, 1]
        z = points[n, 2] + lift * normals[n, 2]
        cx = sun[3] * x + sun[4] * y + sun[5] * z + sun[12]
        cy = sun[6] * x + sun[7] * y + sun[8] * z + sun[13]
        far = sun[9] * x + sun[10] * y + sun[11] * z + sun[14]
        u, v = sun[0] * cx / far + sun[1], sun[0] * cy / far + sun[2]
        # the surface's own plane in the light's picture: beside the point it is as much nearer or farther
        nx = sun[3] * normals[n, 0] + sun[4] * normals[n, 1] + sun[5] * normals[n, 2]
        ny = sun[6] * normals[n, 0] + sun[7] * normals[n, 1] + sun[8] * normals[n, 2]
        steep = bias / max(cos, STEEPEST)
        across, down, limit = steep * nx, steep * ny, far - MARGIN * bias
        over = reach + 1.5
        if u < -over or v < -over or u > w + over or v > h + over:
            lit[n, 0], lit[n, 1], lit[n, 2] = 1.0, 1.0, 1.0
            continue
        i, j = min(max(int(v), 0), h - 1) // TILE, min(max(int(u), 0), w - 1) // TILE
        if tiles[i, j] >= limit + over * (abs(across) + abs(down)):
            lit[n, 0], lit[n, 1], lit[n, 2] = 1.0, 1.0, 1.0
            continue
        taps = places.shape[0]
        r, g, b = 0.0, 0.0, 0.0
        for t in range(taps):
            x, y = u + places[t, 0] - 0.5, v + places[t, 1] - 0.5
            j0, i0 = int(math.floor(x)), int(math.floor(y))
            a, c = x - j0, y - i0
            for k in range(4):
                i, j = i0 + k // 2, j0 + k % 2
                weight = (c if k // 2 else 1.0 - c) * (a if k % 2 else 1.0 - a)
                if i < 0 or j < 0 or i >= h or j >= w:
                    r, g, b = r + weight, g + weight, b + weight
                    continue
                here = limit + across * (j + 0.5 - u) + down * (i + 0.5 - v)
                if solid[i, j] > 0.0 and solid[i, j] < here:
                    continue
                if first[i, j] > 0.0 and first[i, j] < here:
                    r, g, b = r + weight * left[i, j, 0], g + weight * left[i, j, 1], b + weight * left[i, j, 2]
                else:
                    r, g, b = r + weight, g + weight, b + weight
        lit[n, 0], lit[n, 1], lit[n, 2] = r / taps, g / taps, b / taps


@shared(lambda coarse, step, depth, *_: (0, depth.shape[0]), error_model="numpy")
def filled_in(begin, end, coarse, step, depth, normal, alike, out):
    """A picture known in every `step`-th row and column, at all pixels with a depth: between the four known pixels
    around, those count that lie on the same surface (depths within a share `alike`, similar normals)."""
    _, w = depth.shape
    rows, columns = coarse.shape[0], coarse.shape[1]
    for i in range(begin, end):
        for j in range(w):
            if depth[i, j] <= 0.0:
                continue
            r0, c0 = i // step, j // step
            a, b = (j - c0 * step) / step, (i - r0 * step) / step
            total, x, y, z = 0.0, 0.0, 0.0, 0.0
            for k in range(4):
                r, c = min(r0 + k // 2, rows - 1), min(c0 + k % 2, columns - 1)
                m, n = r * step, c * step
                if depth[m, n] <= 0.0:
                    continue
                dot = 0.0
                for q in range(3):
                    dot += normal[i, j, q] * normal[m, n, q]
                off = abs(depth[m, n] - depth[i, j]) / (alike * depth[i, j])
                weight = (b if k // 2 else 1.0 - b) * (a if k % 2 else 1.0 - a) + 1e-3
                weight *= max(dot, 0.01) ** 4 / (1.0 + off * off) ** 2
                total += weight
                x, y, z = x + weight * coarse[r, c, 0], y + weight * coarse[r, c, 1], z + weight * coarse[r, c, 2]
            if total > 0.0:
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = x / total, y / total, z / total


@shared(lambda layer, layer_depth, image, depth: (0, depth.shape[0]))
def lay_over(begin, end, layer, layer_depth, image, depth):
    """A picture laid over another where its depth (m; 0: none) is smaller, in place."""
    for row in range(begin, end):
        for j in range(depth.shape[1]):
            z = layer_depth[row, j]
            if z > 0.0 and (depth[row, j] <= 0.0 or z < depth[row, j]):
                depth[row, j] = z
                for k in range(3):
                    image[row, j, k] = layer[row, j, k]
