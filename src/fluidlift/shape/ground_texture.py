"""The ground's texture: the picture laid on a terrain as a map seen from above, as fine as the picture itself.

What the camera does not see (behind rocks and banks, under the fluid, beyond the picture) is no part of the picture: it
goes on as the seen ground beside it, and neither a rock nor water is painted on what lies behind it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.numerics.textures import sample_texture
from fluidlift.numerics.triangles import rasterize_triangles
from fluidlift.shape.background import filled_in, weight_of_unseen
from fluidlift.shape.generate import MIXED
from fluidlift.shape.ground_mesh import PARTS, cut_colour
from fluidlift.shape.texture_grain import grain
from fluidlift.types import Grid, Label, PinholeCamera, TriangleMesh

LONGEST = 2048
"""texels along the longer side: what any program and graphics card takes"""

STRIP = 8
"""rows of plain earth below the map, for the block's sides and floor: wide enough for three smaller copies of the
texture, as graphics cards make them, before map and earth run into each other"""

FINE = 10.0
"""percentile of the pixels' widths on the ground that counts: the near ground keeps its detail"""

SAMPLES = 2.0
"""texels along a pixel of that width: a picture that is turned and sheared on the way needs more than one"""

PER_PIXEL = 8
"""texels for each pixel of the picture, at most: a view along the ground would spread it over many more"""

RIM = 0.05
"""of the map's longer side: as far from the water, dry ground says what its bed is made of"""

RIM_LEAST = 50
"""texels whose colours tell what is usual"""

ODD = 3.0
"""standard deviations (robust) from the rim's middle colour: that is grass, or water that the mask has missed"""

GRAIN = 0.005
"""of the map's longer side: colours are compared without what is finer"""

EVEN = 0.02
"""of the map's longer side: over this, ground that is not seen is evened out"""

SOFT = 0.008
"""of the map's longer side: over this, the rock under water and the bed run into each other"""

LEAST = 0.4
"""of the grain of the ground is left where it stands; of a rock's none, which would hang about its foot"""

SEAM = 0.02
"""of the picture's longer side: over this, what is drawn behind the fluid goes over from the colours around it to the
ground's own"""

REPOSE = np.tan(np.radians(35.0))
"""slope that gravel lies at, at most: the foot of a rock under water is of rock where it is steeper"""

LYING, WALL = np.cos(np.radians([50.0, 65.0]))
"""cosine of slopes: what is less steep than the first lies, what is steeper than the second stands"""

BROAD = 0.08
"""of the picture's longer side: over this, what the ground slopes by is evened out"""

BRIGHT = 98.0
"""percentile of what lies below the horizon that a white sky is brighter than"""

BLUER = 1.3
"""times more of blue to red has a blue sky than what lies below the horizon"""

SMOOTH = 0.08
"""of its brightness a sky changes by at most within `SKY_RIM` of a place"""

SKY_RIM = 0.01
"""of the picture's longer side: so far beside the sky things are mixed with it"""

JOINT = 3
"""texels that may lie between what was found as a rock on the water and its foot"""


@dataclass(frozen=True)
class GroundView:
    """What the ground was seen as."""

    plate: UInt8[np.ndarray, "h w 3"]
    """sRGB, the scene without its fluid"""
    camera: PinholeCamera
    """in the world"""
    labels: UInt8[np.ndarray, "h w"]
    """what each pixel shows"""
    seen: Bool[np.ndarray, "h w"]
    """pixels of the plate that some frame shows without fluid, or its bed through it"""
    bed: Bool[np.ndarray, "h w"] | None = None
    """pixels of the latter sort: that is the bed, whatever its colour; None: there are none"""


@dataclass(frozen=True)
class _Map:
    """The ground from above, y up."""

    image: np.ndarray
    """float32 [h,w,3], 0 to 255"""
    known: np.ndarray
    """bool [h,w]: the picture shows it"""
    rock: np.ndarray
    """bool [h,w]"""
    drowned: np.ndarray
    """bool [h,w]: bed under the water, where it lies"""
    wall: np.ndarray
    """bool [h,w]: ground that stands behind water"""
    level: np.ndarray
    """float32 [h,w]: 1 where the ground itself lies, 0 where it stands: there a map has few texels"""
    bed: np.ndarray
    """bool [h,w]: bed that is seen through the water"""


def textured(
    mesh: TriangleMesh, grid: Grid, level: Float[np.ndarray, "nx ny"], view: GroundView, *, longest: int = LONGEST
) -> TriangleMesh:
    """A terrain's block with a texture, and with vertex colours taken from it.

    Args:
        mesh: made by `ground_mesh` on this grid.
        grid: of the terrain.
        level: z of the water's surface over each column (also where it is dry), m: rocks were found on it.
        view: the picture.
        longest: most texels along the longer side.
    """
    nodes = (grid.shape[0] * PARTS + 1, grid.shape[1] * PARTS + 1)
    top = mesh.vertices[: nodes[0] * nodes[1]].reshape(*nodes, 3).astype(np.float64)
    found = _map(top, level, view, _texel(top, view.camera, longest))
    image = _continued(found)
    earth = 255.0 * cut_colour(image[found.known if found.known.any() else ~found.known] / 255.0)
    strip = np.broadcast_to(earth, (STRIP, image.shape[1], 3))
    texture = np.clip(np.round(np.concatenate([image, strip])), 0, 255).astype(np.uint8)
    uv = _coordinates(mesh, top, image.shape[0])
    return replace(mesh, uv=uv, texture=texture, colors=_vertex_colours(mesh, uv, texture))


def over_bed(
    plate: UInt8[np.ndarray, "h w 3"],
    kept: Bool[np.ndarray, "h w"],
    mesh: TriangleMesh,
    camera: PinholeCamera,
) -> UInt8[np.ndarray, "h w 3"]:
    """The scene without its fluid, with the textured ground where it is not the clip's own picture.

    Only ground that lies: a map from above has few texels on a wall, and the wall behind water that stands before the
    open sky is none. What the rim of the hole shows goes on there.

    Args:
        plate: sRGB.
        kept: pixels of it that are the clip's.
        mesh: of the ground, as `textured` gives it.
        camera: of the plate, in the world.
    """
    found = rasterize_triangles(mesh.vertices, mesh.faces, camera)
    if mesh.uv is None or mesh.texture is None:
        return plate
    # where the block is cut off it shows earth, and the scene goes on
    on_map = mesh.uv[..., 1].max(axis=1) * mesh.texture.shape[0] < mesh.texture.shape[0] - 0.5 * STRIP
    drawn = (found.face >= 0) & on_map[found.face]
    if not drawn.any():
        return plate
    uv = (mesh.uv[found.face] * found.barycentric[..., None]).sum(axis=-2)
    ground = 255.0 * sample_texture(mesh.texture, uv)
    ground += _membrane(plate - ground, kept & drawn)
    weight = (weight_of_unseen(kept) * drawn * (1.0 - _standing(mesh, found.face)))[..., None]
    return np.clip(np.round(plate * (1.0 - weight) + ground * weight), 0, 255).astype(np.uint8)


def _membrane(difference: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """What is added to the ground that is drawn into a hole, so that no edge runs along its rim, float32 [h,w,3].

    The difference from the picture is taken over at the rim and evened out from there (Perez, Gangnet, Blake 2003,
    "Poisson image editing": the membrane of seamless cloning), and fades inwards: far from the rim the ground's own
    colours are the better guess.

    Args:
        difference: of the picture to the ground, float [h,w,3].
        kept: bool [h,w], where the picture is the clip's.
    """
    if not kept.any():
        return np.zeros(difference.shape, np.float32)
    away = ndimage.distance_transform_edt(~kept) / (SEAM * max(kept.shape))
    return filled_in(difference.astype(np.float32), kept) * np.exp(-away)[..., None].astype(np.float32)


def _standing(mesh: TriangleMesh, face: np.ndarray) -> np.ndarray:
    """How far the ground stands that each pixel shows, float32 [h,w]: 0 where it lies, 1 where it is a wall.

    Of a mean normal: the foot of a rock and a low bank are parts of ground that lies.

    Args:
        mesh: of the ground.
        face: int [h,w], -1 where none is drawn.
    """
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float32) for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    mean = cv2.GaussianBlur(normal[face] * (face >= 0)[..., None], (0, 0), BROAD * max(face.shape))
    return 1.0 - _lying(mean[..., 2] / np.maximum(np.linalg.norm(mean, axis=-1), 1e-12))


def _lying(upward: np.ndarray) -> np.ndarray:
    """1 where something lies, 0 where it stands, by the upward part of its normal."""
    return np.clip((upward - WALL) / (LYING - WALL), 0.0, 1.0).astype(np.float32)


def _texel(top: np.ndarray, camera: PinholeCamera, longest: int) -> float:
    """Width of a texel, m."""
    points = top.reshape(-1, 3)
    uv, depth = camera.project(points)
    inside = (depth > 0) & (uv >= 0).all(-1) & (uv < np.array(camera.size)).all(-1)
    size = np.ptp(points[:, :2], axis=0).max()
    fine = np.percentile(depth[inside], FINE) / max(camera.focal) / SAMPLES if inside.any() else 0.0
    area = float(np.prod(np.ptp(points[:, :2], axis=0)))
    return float(max(fine, size / longest, np.sqrt(area / (PER_PIXEL * camera.size[0] * camera.size[1]))))


def _map(top: np.ndarray, level: np.ndarray, view: GroundView, texel: float) -> _Map:
    """What the picture shows of the ground."""
    camera = view.camera
    low, size = top[0, 0, :2], top[-1, -1, :2] - top[0, 0, :2]
    width, height = (max(int(np.ceil(s / texel)), 2) for s in size)
    x, y = (np.arange(width) + 0.5) / width, 1.0 - (np.arange(height) + 0.5) / height
    place = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1)  # share of the box

    def looked_up(values: np.ndarray, at_centres: bool) -> np.ndarray:
        index = place * (np.array(values.shape) - (0 if at_centres else 1)) - (0.5 if at_centres else 0.0)
        return ndimage.map_coordinates(values, [index[..., 0], index[..., 1]], order=1, mode="nearest")

    ground = np.concatenate([low + place * size, looked_up(top[..., 2], False)[..., None]], -1).reshape(-1, 3)
    uv, depth = camera.project(ground)
    inside = (depth > 0) & (uv >= 0).all(-1) & (uv < np.array(camera.size)).all(-1)
    at = np.where(inside[:, None], uv, 0.0).astype(np.float32).reshape(height, width, 2) - np.float32(0.5)
    image = cv2.remap(view.plate, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    hidden = looked_up(hidden_ground(top, camera.position).astype(np.float32), False) > 0.5
    # a column is rock where the water's surface over it is covered by one, as the plan has it
    surface = np.concatenate([ground[:, :2], looked_up(level, True).reshape(-1, 1)], axis=1)
    row, col, z = camera.nearest_pixels(surface)
    rock = ((z > 0) & (view.labels[row, col] == Label.SOLID)).reshape(height, width)
    row, col, _ = camera.nearest_pixels(ground)
    painted = (view.labels[row, col] == Label.SOLID).reshape(height, width)
    sky = sky_pixels(view.plate, camera)[row, col].reshape(height, width)
    painted_well = _without_rim(view.labels == Label.SOLID)[row, col].reshape(height, width)
    seen = view.seen[row, col].reshape(height, width)
    z_ground, z_water = (points[:, 2].reshape(height, width) for points in (ground, surface))
    rock = _feet(rock, z_ground, z_water, texel)
    wet = (z_ground < z_water) & ~rock
    steps = np.gradient(level, *(np.ptp(top[..., k]) / n for k, n in enumerate(level.shape)))
    lies = looked_up(_lying(1.0 / np.sqrt(1.0 + steps[0] ** 2 + steps[1] ** 2)), True) > 0.5
    drowned, wall = wet & lies, wet & ~lies
    known = inside.reshape(height, width) & ~hidden & ~sky & np.where(rock, painted_well, ~painted)
    known &= wall | rock | seen  # a pixel that always shows fluid shows neither bed nor bank
    slopes = np.gradient(z_ground, texel)
    level_there = _lying(1.0 / np.sqrt(1.0 + slopes[0] ** 2 + slopes[1] ** 2))
    bed = np.zeros_like(known) if view.bed is None else view.bed[row, col].reshape(height, width) & known & drowned
    return _Map(image.astype(np.float32), known, rock, drowned, wall, level_there, bed)


def sky_pixels(plate: UInt8[np.ndarray, "h w 3"], camera: PinholeCamera) -> Bool[np.ndarray, "h w"]:
    """What of a picture shows the sky, with the twigs and the blur at its rim.

    Above the horizon, from the picture's upper edge on, as smooth as only a sky is; and as bright as what lies below
    hardly ever is, since that has its light from the sky, or bluer and no darker than is usual there. Where the
    horizon is above the picture there is none.

    Args:
        plate: sRGB.
        camera: in the world.
    """
    above = camera.rays(camera.pixel_grid())[..., 2] > 0.0
    below = plate[~above].astype(np.float32)
    if not above.any() or len(below) == 0:
        return np.zeros(above.shape, bool)
    picture = cv2.GaussianBlur(plate, (0, 0), 1.0).astype(np.float32)
    grey, blue = picture.mean(axis=-1), picture[..., 2] / (picture[..., 0] + 1.0)
    bright = grey > np.percentile(below.mean(axis=-1), BRIGHT)
    bluer = (blue > BLUER * np.median(below[:, 2] / (below[:, 0] + 1.0))) & (grey > np.median(below.mean(axis=-1)))
    reach = max(round(SKY_RIM * max(above.shape)), 1)
    square = np.ones((2 * reach + 1,) * 2, np.uint8)
    even = cv2.dilate(grey, square) - cv2.erode(grey, square) < SMOOTH * grey
    core = cv2.morphologyEx((above & (bright | bluer) & even).astype(np.uint8), cv2.MORPH_OPEN, square)  # no specks
    core = cv2.dilate(core, square)
    parts = cv2.connectedComponents(core, connectivity=4)[1]
    return cv2.dilate(((core > 0) & np.isin(parts, parts[0][core[0] > 0])).astype(np.uint8), square) > 0


def _without_rim(rock: np.ndarray) -> np.ndarray:
    """bool [h,w]: the pixels of rocks without those that are mixed with what is beside them, `MIXED` of them; of a
    rock of which nothing would be left, without one."""
    parts, count = ndimage.label(rock)
    square = np.ones((3, 3), np.uint8)
    well, little = (cv2.erode(rock.astype(np.uint8), square, iterations=k) > 0 for k in (MIXED, 1))
    large = np.zeros(count + 1, bool)
    large[parts[well]] = True
    return np.where(large[parts], well, little)


def _feet(rock: np.ndarray, height: np.ndarray, level: np.ndarray, texel: float) -> np.ndarray:
    """bool [h,w]: rocks on the water, and what goes down from them below its level (m) more steeply than gravel."""
    if not rock.any():
        return rock
    away = texel * ndimage.distance_transform_edt(~rock)
    falls = -sum(a * b for a, b in zip(np.gradient(away), np.gradient(height), strict=True)) / texel**2
    near = away <= JOINT * texel
    foot = (level - height > REPOSE * (away - JOINT * texel)) & ((falls > REPOSE) | near)
    return ndimage.binary_fill_holes(ndimage.binary_propagation(rock, mask=rock | foot))


def hidden_ground(top: Float[np.ndarray, "nx ny 3"], eye: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "nx ny"]:
    """Nodes of a height field that other ground hides from a point above it.

    Args:
        top: points on even steps in x and y, m.
        eye: the point, m.
    """
    h = float(top[1, 0, 0] - top[0, 0, 0])
    z = top[..., 2]
    toward = eye - top
    away = np.linalg.norm(toward[..., :2], axis=-1)
    step = toward[..., :2] / np.maximum(away, 1e-12)[..., None]
    rise = toward[..., 2] / np.maximum(away, 1e-12)  # of the ray, per m on the ground
    hidden = np.zeros(z.shape, bool)
    column, row = np.meshgrid(*(np.arange(n, dtype=float) for n in z.shape), indexing="ij")
    highest = float(z.max())
    for k in range(1, sum(z.shape)):
        i, j, ray = column + k * step[..., 0], row + k * step[..., 1], z + k * h * rise
        going = ~hidden & (k * h < away) & (ray < highest)
        going &= (i >= 0) & (j >= 0) & (i <= z.shape[0] - 1) & (j <= z.shape[1] - 1)
        if not going.any():
            break
        met = ndimage.map_coordinates(z, [i[going], j[going]], order=1)
        hidden[going] = met > ray[going] + 0.1 * h  # less is the rounding of the field between its nodes
    return hidden


def _continued(found: _Map) -> np.ndarray:
    """Unknown texels from the known ones: rock from rock, the bed from itself and its rim, dry ground from dry.

    Each goes on in its evened-out colours with its grain. Under water what goes on as rock runs into what goes on as
    bed: nobody has seen a line between them.
    """
    dry = ~found.rock & ~found.drowned & ~found.wall
    out = found.image
    bed = _of_the_bed(found, dry)
    for part, beside in ((found.drowned, bed), (found.rock, found.rock), (found.wall, found.wall), (dry, dry)):
        source = found.known & beside
        hole = part & ~source
        if not source.any():
            source = found.known
        if hole.any() and source.any():
            weight = hole.astype(np.float32)
            least = LEAST
            if part is found.rock:
                weight, least = _blurred_into(hole, found.drowned), 0.0
            filling = _filled(found, source, least)
            out = np.where(weight[..., None] > 0.0, out + weight[..., None] * (filling - out), out)
    return out


def _blurred_into(hole: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Weight of a hole's filling, float32 [h,w]: 1 in it, and less and less over what lies beside it."""
    sigma = SOFT * max(hole.shape)
    both = cv2.GaussianBlur((hole | beside).astype(np.float32), (0, 0), sigma)
    soft = cv2.GaussianBlur(hole.astype(np.float32), (0, 0), sigma) / np.maximum(both, 1e-6)
    return np.where(hole, 1.0, np.where(beside, np.minimum(2.0 * soft, 1.0), 0.0)).astype(np.float32)


def _of_the_bed(found: _Map, dry: np.ndarray) -> np.ndarray:
    """bool [h,w]: bed, and dry ground close to it, in colours that are usual there."""
    if not found.drowned.any():
        return found.drowned
    if found.bed.sum() >= RIM_LEAST:  # what is seen of it tells more than its rim
        return found.bed
    near = ndimage.distance_transform_edt(~found.drowned) < RIM * max(dry.shape)
    rim = found.known & dry & near
    if rim.sum() < RIM_LEAST:
        return found.drowned
    colour = _mean(found.image, found.known, GRAIN * max(dry.shape))
    middle = np.median(colour[rim], axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(colour[rim] - middle), axis=0), 2.0)
    usual = np.all(np.abs(colour - middle) < ODD * spread, axis=-1)
    # between odd and usual colours lie mixed ones
    usual = ndimage.binary_erosion(usual, iterations=max(round(2.0 * GRAIN * max(dry.shape)), 1), border_value=1)
    return usual & (found.drowned | (dry & near))


def _filled(found: _Map, source: np.ndarray, least: float) -> np.ndarray:
    """Evened-out colours of the source everywhere, with its grain where the ground lies, and `least` of it on a
    wall, where it is drawn out."""
    sigma = EVEN * max(source.shape)
    mean = _mean(found.image, source, sigma)
    fine = np.maximum(found.level, least)[..., None] * grain(found.image, mean, source)
    return cv2.GaussianBlur(filled_in(mean, source), (0, 0), 0.5 * sigma) + fine


def _mean(image: np.ndarray, source: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian mean over the texels of a source."""
    weight = cv2.GaussianBlur(source.astype(np.float32), (0, 0), sigma)
    return cv2.GaussianBlur(image * source[..., None], (0, 0), sigma) / np.maximum(weight, 1e-6)[..., None]


def _coordinates(mesh: TriangleMesh, top: np.ndarray, rows: int) -> np.ndarray:
    """uv [f,3,2]: the map on the faces of the top, the strip of earth on the sides and the floor."""
    low, size = top[0, 0, :2], top[-1, -1, :2] - top[0, 0, :2]
    share = np.clip((mesh.vertices[:, :2] - low) / size, 0.0, 1.0)
    v = (1.0 - share[:, 1]) * rows / (rows + STRIP)
    uv = np.stack([share[:, 0], v], axis=-1)[mesh.faces]
    uv[2 * (top.shape[0] - 1) * (top.shape[1] - 1) :] = (0.5, (rows + 0.6 * STRIP) / (rows + STRIP))
    return uv.astype(np.float32)


def _vertex_colours(mesh: TriangleMesh, uv: np.ndarray, texture: np.ndarray) -> np.ndarray:
    """sRGB [v,3]; a vertex of the rim has the colour of the top."""
    corner = np.zeros((len(mesh.vertices), 2), np.float32)
    corner[mesh.faces[::-1].ravel()] = uv[::-1].reshape(-1, 2)  # the last one stays: faces of the top come first
    return sample_texture(texture, corner)
