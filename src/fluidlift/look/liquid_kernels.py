"""The compiled loops of `liquid`: where the light of each pixel comes from, and how bright it is (Numba). Camera axes,
metres, float32 out. `shade` in NumPy is `liquid.shaded_plain`.

What works on one pixel makes no arrays and is compiled without counting who holds them (`_nrt`): that counting, of a
dozen arrays in every call, takes longer than the light. So does handing them over, a hundred numbers on the stack: the
compiler puts what runs in every pixel where it is called (`forceinline`, which costs less compiling than Numba's own).
"""

# pyright: reportCallIssue=false
# numba's stub of `njit` does not know `_nrt`, without which a kernel does not count references to arrays

from __future__ import annotations

import math

import numba as nb
import numpy as np

from fluidlift.look.environment_stack import fading, place_of, value_at
from fluidlift.look.liquid_lookup import blurred_end, borders, fetch_beyond, hides, seen_beside, shown_of_film
from fluidlift.look.smoothstep import eased
from fluidlift.look.transparent_rays import fanned, far_side, onward, seen_from, turned_normals
from fluidlift.numerics.sharing import PIECES, shared

STEPS = 3
"""times that the ray behind the liquid looks up how far away what it meets is"""
FACING = 0.02
"""cosine that a normal keeps towards the viewer, however the surface is interpolated"""
LEAST = 0.15
"""cosine below which a ray is less and less bent or mirrored at the far side: it would run along in it"""
ROOM = 16.0
"""px: a liquid that is less than this from what lies behind it rests on it, in part"""
RESTS = 0.25
"""of its thickness: likewise"""
CLOSED = 4.0
"""grains, two radii of particles: a gap to the ground that is narrower than this is none, since they do not know the
ground any better. Seen as a film of air it would mirror, in sparks"""
LEGS = 3
"""times that light which is mirrored inside is followed on"""
TRACED = 0.02
"""share of the light from which that is worth it"""
FAR_AWAY = 1e6
"""px, beyond any rim"""
APART = 4.0 / math.sqrt(3.0)
"""the next pixel's light goes 4 WIDE beside this one's; a bilinear look-up of means over a texel is as wide as a box of
sqrt(3) texels"""
SHARE, MIRROR, THROUGH, PATH, OUTSIDE, TURNED, INWARD, COLOR, SPREAD = 0, 1, 4, 7, 8, 9, 10, 13, 16
FARTHER, BEYOND, SECOND, WIDE, PLACE, HAZE, FREE = 17, 18, 19, 22, 23, 25, 28
"""places in the numbers of a ray: see `follow`"""
NUMBERS = 29
"""of a ray"""


@nb.njit(cache=True, inline="always")
def reflectance(cos, index):
    """Share reflected from outside (see `optics.fresnel`), for 0 < cos <= 1."""
    slower = 1.0 / index  # the same for all pixels: taken out of the loop
    far = math.sqrt(max(1.0 - (1.0 - cos * cos) * slower * slower, 0.0))
    one, two = cos + index * far, index * cos + far
    across, along = (cos - index * far) * two, (index * cos - far) * one
    both = one * two
    return 0.5 * (across * across + along * along) / (both * both)


@nb.njit(cache=True, inline="always")
def _onto(x, y, z, lens):
    """Picture coordinates (px) of a point or direction in front of the camera."""
    near = 1.0 / z  # here as elsewhere: a division takes as long as ten products
    return lens[0] * x * near + lens[2], lens[1] * y * near + lens[3]


@nb.njit(cache=True, error_model="numpy", _nrt=False)
def _behind(q, o, start, depth, front, lens, up, rest, liquid, rests):
    """Where a ray that leaves the liquid at q towards o meets what lies behind: u, v (px), whether the picture holds
    it, and how far it went, over the depth at which it ends (1: to infinity). `start`: u, v of the straight line;
    `front`: z of the liquid; `up`: world z in camera axes; `rest`: as of `Behind`; `liquid`, `rests`: as of
    `hides`."""
    h, w = depth.shape
    goes_on = rest[3] > 0.0
    u, v = start
    if o[2] < 0.05:  # back to the viewer
        return FAR_AWAY, FAR_AWAY, goes_on, 1.0
    before, onward_z, gone = -1.0, 1.0 / o[2], 1.0
    for _ in range(STEPS):
        row, col = min(max(int(v), 0), h - 1), min(max(int(u), 0), w - 1)
        z = depth[row, col]
        if z == before:  # as far away as it was: it is met where it was
            break
        before = z
        if z > 0.0:
            s = max(z - q[2], 0.0) * onward_z
            u, v = _onto(q[0] + s * o[0], q[1] + s * o[1], max(q[2] + s * o[2], 1e-6), lens)
            gone = s / z
        else:
            u, v = _onto(o[0], o[1], o[2], lens)
            gone = 1.0
    if front > 0.0:
        a, b = blurred_end(start, u, v, rest[4])
        if hides(depth, liquid, rests, min(max(int(b), 0), h - 1), min(max(int(a), 0), w - 1), front):
            u, v = seen_beside(start, (a, b), depth, front, q[2], liquid, rests, rest[4])
            return u, v, True, 0.0
    row, col = min(max(int(v), 0), h - 1), min(max(int(u), 0), w - 1)
    z = depth[row, col]
    if front > 0.0 and borders(depth, row, col, u, v, front):
        u, v = col + 0.5, row + 0.5
    # beyond the rim ground goes on, and the sky is known all around
    outside = (u < 0.0 or v < 0.0 or u > w or v > h) and not goes_on
    upward = o[0] * up[0] + o[1] * up[1] + o[2] * up[2] > 0.0
    return u, v, not (outside and (z == 0.0 or upward)), gone


@nb.njit(cache=True, error_model="numpy", forceinline=True, _nrt=False)
def _turned(rotation, x, y, z, out, at):
    """A direction of camera axes in the world."""
    for k in range(3):
        out[at + k] = rotation[0, k] * x + rotation[1, k] * y + rotation[2, k] * z


@nb.njit(cache=True, inline="always")
def _towards_viewer(nx, ny, nz, vx, vy, vz):
    """A normal turned just far enough to face the viewer, and its cosine to the line of sight."""
    cos = -(nx * vx + ny * vy + nz * vz)
    if cos < FACING:
        more = FACING - cos
        nx, ny, nz = nx - more * vx, ny - more * vy, nz - more * vz
        norm = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-6)
        nx, ny, nz = nx / norm, ny / norm, nz / norm
        cos = max(-(nx * vx + ny * vy + nz * vz), FACING)
    return nx, ny, nz, min(cos, 1.0)


@nb.njit(cache=True, inline="always")
def _leaving(tx, ty, tz, bx, by, bz, vx, vy, vz, index, free):
    """What a ray t does where it leaves the liquid with outward normal b: the direction in which it goes on, the share
    that is mirrored back (Fresnel's from inside: it rises to all of it without a step), and where to.

    free: 0 to 1; where the liquid rests on something there is no far side: the line of sight v goes straight on.
    """
    leaving = tx * bx + ty * by + tz * bz
    free *= eased(leaving * (1.0 / LEAST))
    if free <= 0.0:
        return vx, vy, vz, 0.0, tx, ty, tz
    mx, my, mz = tx - 2.0 * leaving * bx, ty - 2.0 * leaving * by, tz - 2.0 * leaving * bz
    left = 1.0 - index * index * (1.0 - leaving * leaving)
    if left <= 0.0:
        return vx, vy, vz, free, mx, my, mz
    out = math.sqrt(left)
    bend = out - index * leaving
    ox = vx + free * (index * tx + bend * bx - vx)
    oy = vy + free * (index * ty + bend * by - vy)
    oz = vz + free * (index * tz + bend * bz - vz)
    unit = 1.0 / max(math.sqrt(ox * ox + oy * oy + oz * oz), 1e-6)
    back = free * reflectance(min(out, 1.0), index)  # the same seen from either side
    return ox * unit, oy * unit, oz * unit, back, mx, my, mz


@nb.njit(cache=True, error_model="numpy", _nrt=False)
def _inner(q, m, share, thick, turns, surface, behind, eye, index, ray):
    """What is seen by light that is mirrored at q, on the far side, into m: fills FARTHER, BEYOND, INWARD, SECOND.
    turns: of that light within the pixel, before it is mirrored, and of the normals that mirror it (as those of
    `turned_normals`)."""
    _, surface_depth, normals, back_normals, thickness, _, _ = surface
    picture, levels, depth, rest = behind
    lens, rotation = eye
    o, more, turn = m, 0.0, turns[0] + 2.0 * turns[1]
    if share > TRACED:
        for _ in range(LEGS):
            found, s, bx, by, bz = onward(q, m, thick, (surface_depth, thickness, depth), normals, back_normals, eye)
            if not found:  # it was last seen on its way there
                o = m
                break
            more += s
            turn += 2.0 * turns[1]
            q = (q[0] + s * m[0], q[1] + s * m[1], q[2] + s * m[2])
            ox, oy, oz, back, mx, my, mz = _leaving(m[0], m[1], m[2], bx, by, bz, m[0], m[1], m[2], index, 1.0)
            o, m = (ox, oy, oz), (mx, my, mz)
            if back < 0.5:
                break
            o = m
    ray[FARTHER] = more
    start = _onto(q[0], q[1], max(q[2], 1e-6), lens)
    up = (rotation[0, 2], rotation[1, 2], rotation[2, 2])
    u, v, held, gone = _behind(q, o, start, depth, 0.0, lens, up, rest, surface_depth, False)
    ray[BEYOND] = 0.0 if held else 1.0
    _turned(rotation, o[0], o[1], o[2], ray, INWARD)
    if held:
        fetch_beyond(picture, levels, u, v, 2.0 * index * turn * gone * lens[0], rest, ray, SECOND)


@nb.njit(cache=True, inline="always")
def _to_far_side(i, j, p, v, t, n, surface, depth, eye):
    """Metres from p, on the near side with normal n, along the bent ray t to the far side; the outward normal there;
    metres of liquid along the line of sight v; and how free its end is, from 0, where it rests on something, to 1.
    """
    _, surface_depth, _, back_normals, thickness, _, grain = surface
    lens, rotation = eye
    bx, by, bz = -n[0], -n[1], -n[2]
    known = False
    if back_normals.shape[0] > 0:
        x, y, z = seen_from(back_normals, i, j, rotation)
        known = x * x + y * y + z * z > 0.5
        if known:
            bx, by, bz = x, y, z
    thick, end = np.float64(thickness[i, j]), depth[i, j]
    if end > 0.0:
        thick = min(thick, max(end - p[2], 0.0) / v[2])
    way, straight = thick, v[0] * bx + v[1] * by + v[2] * bz
    leaving = t[0] * bx + t[1] * by + t[2] * bz
    if leaving > LEAST and straight > 0.0:
        way = min(thick * straight / leaving, 2.0 * thick)
    free = 1.0
    if end > 0.0:
        gap = end - p[2] - thick * v[2] - CLOSED * grain
        free = min(gap / max(RESTS * thick, ROOM * p[2] * lens[4], 1e-9), 1.0) if gap > 0.0 else 0.0
    if known and free > 0.0:
        sides = (surface_depth, thickness, depth)
        way, bx, by, bz = far_side(p, t, way, (bx, by, bz), sides, back_normals, eye)
    return way, bx, by, bz, thick, free


@nb.njit(cache=True, error_model="numpy", forceinline=True, _nrt=False)
def _follow(i, j, surface, behind, eye, index, ray):
    """One pixel of `follow`."""
    _, surface_depth, normals, back_normals, _, _, grain = surface
    picture, levels, depth, rest = behind
    lens, rotation = eye
    x, y = (j + 0.5 - lens[2]) * lens[4], (i + 0.5 - lens[3]) * lens[5]
    vz = 1.0 / math.sqrt(x * x + y * y + 1.0)
    vx, vy = x * vz, y * vz
    nx, ny, nz = seen_from(normals, i, j, rotation)
    nx, ny, nz, cos = _towards_viewer(nx, ny, nz, vx, vy, vz)
    ray[SHARE] = reflectance(cos, index)
    _turned(rotation, vx + 2.0 * cos * nx, vy + 2.0 * cos * ny, vz + 2.0 * cos * nz, ray, MIRROR)
    # into the liquid
    slower = 1.0 / index
    bend = cos * slower - math.sqrt(max(1.0 - (1.0 - cos * cos) * slower * slower, 0.0))
    tx, ty, tz = vx * slower + bend * nx, vy * slower + bend * ny, vz * slower + bend * nz
    z0 = np.float64(surface_depth[i, j])
    p = (x * z0, y * z0, z0)
    way, bx, by, bz, thick, free = _to_far_side(
        i, j, p, (vx, vy, vz), (tx, ty, tz), (nx, ny, nz), surface, depth, eye
    )  # fmt: skip
    ray[PATH] = way
    q = (p[0] + way * tx, p[1] + way * ty, p[2] + way * tz)
    # out again; where the liquid rests on something, light meets that at once, and there is no other surface
    if free > 0.0 and q[2] > 1e-6:
        u, v = _onto(q[0], q[1], q[2], lens)
        end = depth[min(max(int(v), 0), depth.shape[0] - 1), min(max(int(u), 0), depth.shape[1] - 1)]
        if end > 0.0:
            free = min(free, max((end - q[2] - CLOSED * grain) / max(RESTS * thick, ROOM * z0 * lens[4], 1e-9), 0.0))
    ox, oy, oz, back, mx, my, mz = _leaving(tx, ty, tz, bx, by, bz, vx, vy, vz, index, free)
    ray[SPREAD] = turned_normals(surface_depth, normals, i, j)
    ray[TURNED], ray[WIDE] = 0.0, 0.0
    if back_normals.shape[0] > 0 and free > 0.0:
        far = turned_normals(surface_depth, back_normals, i, j)
        ray[TURNED] = back
        ray[WIDE] = free * fanned(bend, tx * bx + ty * by + tz * bz, ray[SPREAD], far, index)
        if back > 0.0:
            turns = abs(bend) * ray[SPREAD], far
            _inner(q, (mx, my, mz), back, thick, turns, surface, behind, eye, index, ray)
    up = (rotation[0, 2], rotation[1, 2], rotation[2, 2])
    u, v, held, gone = _behind(
        q, (ox, oy, oz), (j + 0.5, i + 0.5), depth, z0, lens, up, rest, surface_depth, free <= 0.0
    )  # fmt: skip
    ray[OUTSIDE] = 0.0 if held else 1.0
    _turned(rotation, ox, oy, oz, ray, THROUGH)
    ray[PLACE], ray[PLACE + 1], ray[FREE] = u, v, free
    if held:
        fetch_beyond(picture, levels, u, v, APART * ray[WIDE] * gone * lens[0], rest, ray, COLOR)


@nb.njit(cache=True, error_model="numpy", forceinline=True, _nrt=False)
def _hazed(i, j, surface, behind, eye, ray):
    """What is seen by light that is scattered forward on its way: it comes from about as far to the side as it went."""
    picture, levels, _, rest = behind
    if ray[OUTSIDE] > 0.0:
        return
    wide = ray[PATH] * eye[0][0] / max(np.float64(surface[1][i, j]), 1e-6)
    fetch_beyond(picture, levels, ray[PLACE], ray[PLACE + 1], wide, rest, ray, HAZE)


@shared(lambda pixels, *_: (0, pixels.shape[0]), error_model="numpy", pieces=PIECES)
def follow(begin, end, pixels, surface, behind, eye, index, rays):
    """What becomes of the ray of every pixel of `pixels` (row, column): [n, NUMBERS], in this order.

    - share of light that the near side mirrors; directions (world) of the mirrored and of the refracted ray;
    - the refracted ray: metres in the liquid; 1 where its light comes from the environment, 0 from the picture; share
      that the far side mirrors back inside, and the direction in which that leaves; colour from the picture;
    - spread of the normals, as GGX's alpha;
    - what the far side mirrors back: metres that it goes on inside; 1 for the environment; colour from the picture;
    - the refracted ray again: how wide it is fanned out (as GGX's alpha); where in the picture it ends (px); colour
      around there, averaged as widely as light is scattered; and how free the far side is, from 0, where the liquid
      rests on something, to 1.

    surface, behind, eye: as of `shade`.
    """
    for m in range(begin, end):
        _follow(pixels[m, 0], pixels[m, 1], surface, behind, eye, index, rays[m])
        _hazed(pixels[m, 0], pixels[m, 1], surface, behind, eye, rays[m])


@nb.njit(cache=True, inline="always")
def _looked_up(values, places, k, ray, at):
    across, down = place_of(np.float32(ray[at]), np.float32(ray[at + 1]), np.float32(ray[at + 2]))
    return value_at(values, places[k, 0], places[k, 1], across, down)


@nb.njit(cache=True, error_model="numpy", forceinline=True, _nrt=False)
def _blurred(values, places, steps, roughness, ray, at):
    """`Environment.blurred` for the direction in `ray` from `at` on."""
    last = steps.shape[0] - 1
    k = 0
    while k < last - 1 and roughness >= steps[k + 1]:
        k += 1
    share = min(max((roughness - steps[k]) / (steps[k + 1] - steps[k]), 0.0), 1.0)
    across, down = place_of(np.float32(ray[at]), np.float32(ray[at + 1]), np.float32(ray[at + 2]))
    r0, g0, b0 = value_at(values, places[k, 0], places[k, 1], across, down)
    if share <= 0.0:
        return r0, g0, b0
    r1, g1, b1 = value_at(values, places[k + 1, 0], places[k + 1, 1], across, down)
    s = np.float32(share)
    return r0 + s * (r1 - r0), g0 + s * (g1 - g0), b0 + s * (b1 - b0)


@nb.njit(cache=True, inline="always")
def _cloud_seen(fade, cloud, extinction, inside, way, free):
    """`optics.cloud_seen`, compiled."""
    left, held = math.exp(-fade * way), 1.0 - inside
    many = max(1.0 - cloud * cloud * left * left, 1e-30)
    through, back = (1.0 - cloud * cloud) * left / many, cloud * (1.0 - left * left) / many
    straight = min(math.exp(-extinction * way), through)
    near, twice = 1.0 - inside * back, left * left
    many = max(1.0 - cloud * cloud * twice * twice, 1e-30)
    slanted, again = (1.0 - cloud * cloud) * twice / many, 1.0 - inside * cloud * (1.0 - twice * twice) / many
    f = held * again / (again * again - inside * inside * slanted * slanted)
    b = inside * slanted / again * f
    haze = (1.0 - free) * (through / near - straight) + free * ((through - straight) * f + back * b)
    own = (1.0 - free) * held * back / near + free * (back * f + (through - straight) * b)
    return straight, haze, own * (1.0 - inside * cloud) / (held * cloud)


@nb.njit(cache=True, error_model="numpy", forceinline=True, _nrt=False)
def _come_through(ray, values, places, steps, dim, numbers, light):
    """What comes through, of the picture behind or the environment, and of what is mirrored at the far side, after its
    way inside; and how much of its own colour the body shows in its place: of a clear one all that it takes."""
    back = ray[TURNED]
    light[0], light[1], light[2] = ray[COLOR], ray[COLOR + 1], ray[COLOR + 2]
    if ray[OUTSIDE] > 0.0 and back < 1.0:
        wide = math.sqrt(max(ray[WIDE] - numbers[6], 0.0))
        light[0], light[1], light[2] = _blurred(values, places, steps, wide, ray, THROUGH)
    r, g, b = ray[SECOND], ray[SECOND + 1], ray[SECOND + 2]
    if back > 0.0 and ray[BEYOND] > 0.0:
        r, g, b = _looked_up(values, places, dim, ray, INWARD)
    for k in range(3):
        lost, cloud = numbers[24 + k], numbers[27 + k]
        inner, left = (r if k == 0 else (g if k == 1 else b)), 1.0
        if cloud > 0.0:
            taken = numbers[12 + k] + numbers[2]
            straight, haze, own = _cloud_seen(lost, cloud, taken, numbers[30], ray[PATH], ray[FREE])
            light[3 + k] = own
            light[k] = straight * light[k] + haze * (light[k] if ray[OUTSIDE] > 0.0 else ray[HAZE + k])
            if back > 0.0:
                both = ray[PATH] + ray[FARTHER]
                straight, haze, own = _cloud_seen(lost, cloud, taken, numbers[30], both, ray[FREE])
                inner *= straight + haze
                light[k] = inner if back >= 1.0 else light[k] + back * (inner - light[k])
                light[3 + k] += back * (own - light[3 + k])
            continue
        if back > 0.0:
            left = fading(lost * ray[FARTHER])
            # all of it: what would come through was not looked up
            light[k] = inner * left if back >= 1.0 else light[k] + back * (inner * left - light[k])
            left = back * left + 1.0 - back
        along = fading(lost * ray[PATH])
        light[k] *= along
        light[3 + k] = 1.0 - along * left


@nb.njit(cache=True, error_model="numpy", forceinline=True, _nrt=False)
def _body(carried, given, numbers, waves, light):
    """Adds what the body scatters and gives off itself, in place of the light that is lost on the way."""
    keeps, usual, cool, hot, warm, contrast = numbers[5], numbers[7], numbers[8], numbers[9], numbers[10], numbers[11]
    bright = 0.0
    for k in range(3):
        light[k] += light[3 + k] * (numbers[15 + k] * (1.0 - keeps) + keeps * carried[k]) * given[k]
        bright += numbers[21 + k] * carried[k]
    if numbers[18] + numbers[19] + numbers[20] > 0.0:
        warmth = 1.0 - (1.0 - warm) ** ((max(bright, 0.0) / usual) ** contrast)
        kelvin = cool + (hot - cool) * warmth
        for k in range(3):
            light[k] += light[3 + k] * numbers[18 + k] * math.exp((1.0 / hot - 1.0 / kelvin) * waves[k])


@nb.njit(cache=True, error_model="numpy", forceinline=True, _nrt=False)
def _pixel(i, j, surface, behind, eye, world, numbers, ray, light):
    """One pixel of `shade`: the light of its liquid."""
    values, places, steps, dim, waves = world
    index, roughness, scattering = numbers[0], numbers[1], numbers[2]
    straight, dull, sharp = numbers[3], numbers[4], numbers[6]
    _follow(i, j, surface, behind, eye, index, ray)
    if numbers[27] + numbers[28] + numbers[29] > 0.0:
        _hazed(i, j, surface, behind, eye, ray)
    _come_through(ray, values, places, steps, dim, numbers, light)
    if scattering > 0.0:
        normals, carried = surface[2], surface[5]
        across, down = place_of(normals[i, j, 0], normals[i, j, 1], normals[i, j, 2])
        given = value_at(values, places[-1, 0], places[-1, 1], across, down)
        _body((carried[i, j, 0], carried[i, j, 1], carried[i, j, 2]), given, numbers, waves, light)
    spread = max(ray[SPREAD] - sharp, 0.0)
    wide = roughness if spread == 0.0 else math.sqrt(math.sqrt(roughness**4 + spread * spread))
    mirror = _blurred(values, places, steps, wide, ray, MIRROR)
    share = straight + (ray[SHARE] - straight) * (1.0 - dull * roughness)
    for k in range(3):
        light[k] = share * mirror[k] + (1.0 - share) * light[k]


@shared(lambda surface, *_: (0, surface[0].shape[0]), error_model="numpy", pieces=PIECES)
def shade(begin, end, surface, behind, eye, world, numbers, out):
    """Adds the liquid to `out`, a copy of the picture; what the numbers are says `liquid.shaded_plain`.

    surface: covered, depth, normals, normals of the far side (of no rows: none), thickness, carried colour, grain.
    behind: picture (`liquid_lookup.pyramid`), depth, and what it is beyond its rim. eye: lens (fx, fy, cx, cy, 1/fx,
    1/fy) and rotation. world: pictures of the environment, ever duller, and that of the irradiance, as `stacked` gives
    them; roughnesses of the former; which of them is seen by what was mirrored at the far side; second radiation
    constant over wavelengths. numbers: index, roughness, scattering, straight, dull, carried share, sharp, usual, cool,
    hot, warm, contrast, then absorption, albedo, emission, weights of luminance, fading, cloud (`Material.fluxes`) and
    the share of light that the surface holds inside.
    """
    covered, surface_depth, normals, back_normals, thickness, carried, grain = surface
    image, levels, depth, rest = behind
    lens, rotation = eye
    values, places, steps, dim, waves = world
    for i in range(begin, end):
        ray, light = np.empty(NUMBERS), np.empty(6)
        # made once: to bundle arrays costs as much as a pixel
        liquid = (covered, surface_depth, normals, back_normals, thickness, carried, grain)
        scene, lens_and_pose = (image, levels, depth, rest), (lens, rotation)
        lights = (values, places, steps, dim, waves)
        for j in range(covered.shape[1]):
            part, z = covered[i, j], surface_depth[i, j]
            if not (part > 0.0 and z > 0.0 and (depth[i, j] <= 0.0 or z < depth[i, j])):
                continue
            part *= shown_of_film(i, j, z, depth, lens, grain)
            if part <= 0.0:
                continue
            _pixel(i, j, liquid, scene, lens_and_pose, lights, numbers, ray, light)
            for k in range(3):
                out[i, j, k] += part * (light[k] - out[i, j, k])
