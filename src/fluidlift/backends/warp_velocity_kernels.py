"""Warp kernels of the velocity on faces: prescribed inflow, what viscosity does where, continuation beyond the liquid,
walls (model: `physics.inlet`, `.surroundings`, `.free_surface.continue_velocity`, `.boundaries`).

Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_faces import (
    Faces,
    Marks,
    Normals,
    cell_or,
    face,
    is_face,
    mark_of,
    normal_of,
    put,
    put_mark,
    step,
)
from fluidlift.physics import free_surface as cpu
from fluidlift.types import CellType

wp.set_module_options({"enable_backward": False})

real = wp.float64
ONE = wp.constant(real(1.0))
FLUID = wp.constant(int(CellType.FLUID))
EMPTY = wp.constant(int(CellType.EMPTY))
INFLOW = wp.constant(int(CellType.INFLOW))
SURE_OPENING = wp.constant(float(cpu.SURE_OPENING))
WET = wp.constant(1)
SURE = wp.constant(2)
KNOWN = wp.constant(4)
"""bits of a face's mark: it belongs to a cell of liquid and is open; its velocity may be continued; it has a value"""


ACROSS = wp.constant(0.7)
"""of the normal of a wall along a component that it stops; other walls drag it by their share"""


@wp.kernel
def face_roles(
    shape: wp.vec3i,
    wet: wp.array3d(dtype=wp.uint8),
    holding: wp.array3d(dtype=wp.uint8),
    openings: Faces,
    normals: Normals,
    prescribed: Marks,
    solved: Marks,
    fixed: Marks,
    walls: Marks,
):
    """What viscosity does on each face (`Surroundings.viscous`): solved on open faces of liquid, fixed where the
    velocity is `prescribed` or a wall stops it, dragged by other walls."""
    axis, i, j, k = wp.tid()
    if not is_face(shape, axis, i, j, k):
        return
    s = step(axis)
    a, b, c = i - s[0], j - s[1], k - s[2]
    moving = cell_or(wet, i, j, k, 0) != 0 or cell_or(wet, a, b, c, 0) != 0
    moving = moving or cell_or(holding, i, j, k, EMPTY) == FLUID or cell_or(holding, a, b, c, EMPTY) == FLUID
    given = mark_of(prescribed, axis, i, j, k) != 0
    closed = face(openings, axis, i, j, k) == 0.0
    across = closed and wp.abs(normal_of(normals, axis, i, j, k)[axis]) > ACROSS
    put_mark(solved, axis, i, j, k, wp.where(moving and not closed and not given, 1, 0))
    put_mark(fixed, axis, i, j, k, wp.where(given or across, 1, 0))
    put_mark(walls, axis, i, j, k, wp.where(closed and not across, 1, 0))


@wp.kernel
def mark_faces(faces: wp.array(dtype=wp.vec4i), first: wp.vec3i, marks: Marks):
    """1 on faces, each (axis, i, j, k) in the whole box."""
    f = faces[wp.tid()]
    put_mark(marks, f[0], f[1] - first[0], f[2] - first[1], f[3] - first[2], 1)


@wp.kernel
def set_faces(faces: wp.array(dtype=wp.vec4i), values: wp.array(dtype=float), first: wp.vec3i, velocity: Faces):
    """Given values on faces, each (axis, i, j, k) in the whole box."""
    n = wp.tid()
    f = faces[n]
    put(velocity, f[0], f[1] - first[0], f[2] - first[1], f[3] - first[2], values[n])


@wp.kernel
def stop_at_walls(shape: wp.vec3i, openings: Faces, velocity: Faces, out: Faces):
    """The velocity, 0 on closed faces."""
    axis, i, j, k = wp.tid()
    if is_face(shape, axis, i, j, k):
        put(out, axis, i, j, k, wp.where(face(openings, axis, i, j, k) > 0.0, face(velocity, axis, i, j, k), 0.0))


@wp.func
def corner_mean(nodes: wp.array3d(dtype=float), axis: int, i: int, j: int, k: int):
    """Of the four corners of a face."""
    if axis == 0:
        return 0.25 * (nodes[i, j, k] + nodes[i, j + 1, k] + nodes[i, j, k + 1] + nodes[i, j + 1, k + 1])
    if axis == 1:
        return 0.25 * (nodes[i, j, k] + nodes[i + 1, j, k] + nodes[i, j, k + 1] + nodes[i + 1, j, k + 1])
    return 0.25 * (nodes[i, j, k] + nodes[i + 1, j, k] + nodes[i, j + 1, k] + nodes[i + 1, j + 1, k])


@wp.kernel
def add_drag(
    shape: wp.vec3i,
    openings: Faces,
    nodes: wp.array3d(dtype=float),
    pressed: Faces,
    viscous: Faces,
    gain: wp.vec3,
    dragging: int,
    velocity: Faces,
):
    """What viscosity has changed of the `pressed` velocity is added; open faces inside a solid that drags take the
    viscous velocity alone (`LiquidGrid._dragged`). `gain`: m/s, by gravity."""
    axis, i, j, k = wp.tid()
    if not is_face(shape, axis, i, j, k):
        return
    new = face(viscous, axis, i, j, k)
    v = face(velocity, axis, i, j, k) + (new - face(pressed, axis, i, j, k))
    if dragging == 1 and face(openings, axis, i, j, k) > 0.0 and corner_mean(nodes, axis, i, j, k) <= 0.0:
        v = new + gain[axis]
    put(velocity, axis, i, j, k, v)


@wp.struct
class Inflow:
    """The prescribed velocity of INFLOW cells as a function of place, at one instant (`physics.inlet.Inlet`)."""

    offset: wp.vec3d
    gain: wp.float64
    """of the profile, which lies on the faces of the whole box"""
    amplitude: wp.float64
    """m/s of each wave of the fluctuation"""
    factor: wp.float64
    time: wp.float64
    low: wp.vec3d
    spacing: wp.float64
    profile: Faces
    waves: wp.array(dtype=wp.vec3d)
    frequencies: wp.array(dtype=wp.float64)
    directions: wp.array(dtype=wp.vec3d)
    phases: wp.array(dtype=wp.float64)


@wp.func
def sampled(f: wp.array3d(dtype=float), s: wp.vec3d):
    """Trilinear value at s (in samples of the field); outside the nearest goes on."""
    x = wp.clamp(s[0], real(0.0), real(f.shape[0] - 1))
    y = wp.clamp(s[1], real(0.0), real(f.shape[1] - 1))
    z = wp.clamp(s[2], real(0.0), real(f.shape[2] - 1))
    i = wp.min(int(x), wp.max(f.shape[0] - 2, 0))
    j = wp.min(int(y), wp.max(f.shape[1] - 2, 0))
    k = wp.min(int(z), wp.max(f.shape[2] - 2, 0))
    fx, fy, fz = x - real(i), y - real(j), z - real(k)
    i1, j1, k1 = wp.min(i + 1, f.shape[0] - 1), wp.min(j + 1, f.shape[1] - 1), wp.min(k + 1, f.shape[2] - 1)
    a = real(f[i, j, k]) * (ONE - fz) + real(f[i, j, k1]) * fz
    b = real(f[i, j1, k]) * (ONE - fz) + real(f[i, j1, k1]) * fz
    c = real(f[i1, j, k]) * (ONE - fz) + real(f[i1, j, k1]) * fz
    d = real(f[i1, j1, k]) * (ONE - fz) + real(f[i1, j1, k1]) * fz
    return (a * (ONE - fy) + b * fy) * (ONE - fx) + (c * (ONE - fy) + d * fy) * fx


@wp.func
def inflow_velocity(inflow: Inflow, x: wp.vec3d):
    """m/s at a place."""
    out = inflow.offset
    if inflow.gain > real(0.0):
        s = (x - inflow.low) / inflow.spacing
        h = real(0.5)
        u = sampled(inflow.profile.x, s - wp.vec3d(real(0.0), h, h))
        v = sampled(inflow.profile.y, s - wp.vec3d(h, real(0.0), h))
        w = sampled(inflow.profile.z, s - wp.vec3d(h, h, real(0.0)))
        out += inflow.gain * wp.vec3d(u, v, w)
    if inflow.amplitude > real(0.0):
        for m in range(inflow.waves.shape[0]):
            angle = wp.dot(x, inflow.waves[m]) - inflow.frequencies[m] * inflow.time + inflow.phases[m]
            out += inflow.amplitude * wp.cos(angle) * inflow.directions[m]
    return out * inflow.factor


@wp.kernel
def impose_inflow(
    inflow: Inflow,
    faces: wp.array(dtype=wp.vec4i),
    points: wp.array(dtype=wp.vec3d),
    first: wp.vec3i,
    velocity: Faces,
):
    """Prescribed faces, each (axis, i, j, k) in the whole box, with its centre."""
    n = wp.tid()
    f = faces[n]
    v = inflow_velocity(inflow, points[n])
    put(velocity, f[0], f[1] - first[0], f[2] - first[1], f[3] - first[2], float(v[f[0]]))


@wp.kernel
def carry_inflow(
    inflow: Inflow,
    regions: wp.array3d(dtype=wp.uint8),
    positions: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    affine: wp.array(dtype=wp.mat33),
):
    """Particles in INFLOW cells (of the whole box) move as prescribed."""
    p = wp.tid()
    x = wp.vec3d(positions[p])
    s = (x - inflow.low) / inflow.spacing
    i, j, k = int(wp.floor(s[0])), int(wp.floor(s[1])), int(wp.floor(s[2]))
    if cell_or(regions, i, j, k, EMPTY) == INFLOW:
        v = inflow_velocity(inflow, x)
        velocities[p] = wp.vec3(float(v[0]), float(v[1]), float(v[2]))
        affine[p] = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@wp.kernel
def mark_wet_faces(shape: wp.vec3i, wet: wp.array3d(dtype=wp.uint8), openings: Faces, marks: Marks):
    """Open faces of cells of liquid."""
    axis, i, j, k = wp.tid()
    if not is_face(shape, axis, i, j, k):
        return
    s = step(axis)
    mark, opening = int(0), face(openings, axis, i, j, k)
    if opening > 0.0 and (cell_or(wet, i, j, k, 0) != 0 or cell_or(wet, i - s[0], j - s[1], k - s[2], 0) != 0):
        mark = WET
        if opening >= SURE_OPENING:
            mark = WET + SURE
    put_mark(marks, axis, i, j, k, mark)


@wp.func
def is_skin(holding: wp.array3d(dtype=wp.uint8), types: wp.array3d(dtype=wp.uint8), i: int, j: int, k: int):
    """Whether `pressure_cells` has made air of a cell of liquid."""
    return cell_or(holding, i, j, k, EMPTY) == FLUID and cell_or(types, i, j, k, FLUID) == EMPTY


@wp.kernel
def carry_skin(
    shape: wp.vec3i,
    holding: wp.array3d(dtype=wp.uint8),
    types: wp.array3d(dtype=wp.uint8),
    openings: Faces,
    masses: Faces,
    carried: Faces,
    velocity: Faces,
    wet: Marks,
    marks: Marks,
    field: Faces,
    grown: Faces,
    layer: Marks,
):
    """The velocity on wet faces and on those of the skin: there the particles' own one with the mean change beside it.

    `marks` are those of `wet` with KNOWN where there is a value; `grown` and `layer` are where continuation begins.
    """
    axis, i, j, k = wp.tid()
    if not is_face(shape, axis, i, j, k):
        return
    s = step(axis)
    v, mark, opening = face(velocity, axis, i, j, k), mark_of(wet, axis, i, j, k), face(openings, axis, i, j, k)
    if mark != 0:
        mark += KNOWN
    else:
        skin = is_skin(holding, types, i, j, k) or is_skin(holding, types, i - s[0], j - s[1], k - s[2])
        if skin and opening > 0.0 and face(masses, axis, i, j, k) > 0.0:
            total, count = float(0.0), int(0)
            for b in range(3):
                t = step(b)
                for side in range(2):
                    sign = 2 * side - 1
                    l, m, n = i + sign * t[0], j + sign * t[1], k + sign * t[2]
                    if is_face(shape, axis, l, m, n) and mark_of(wet, axis, l, m, n) == WET + SURE:
                        total += face(velocity, axis, l, m, n) - face(carried, axis, l, m, n)
                        count += 1
            v = face(carried, axis, i, j, k) + total / float(wp.max(count, 1))
            mark = KNOWN
    put_mark(marks, axis, i, j, k, mark)
    put(field, axis, i, j, k, v)
    if mark >= KNOWN and opening >= SURE_OPENING:
        put(grown, axis, i, j, k, v)
        put_mark(layer, axis, i, j, k, 1)
    else:
        put(grown, axis, i, j, k, 0.0)
        put_mark(layer, axis, i, j, k, 0)


@wp.kernel
def grow(shape: wp.vec3i, number: int, grown: Faces, layer: Marks):
    """One layer, in place: faces without a value take the mean of their neighbours that have an older one.

    `layer` says when a face got its value, so it does not matter which face comes first.
    """
    axis, i, j, k = wp.tid()
    if not is_face(shape, axis, i, j, k) or mark_of(layer, axis, i, j, k) != 0:
        return
    total, count = float(0.0), int(0)
    for b in range(3):
        t = step(b)
        for side in range(2):
            sign = 2 * side - 1
            l, m, n = i + sign * t[0], j + sign * t[1], k + sign * t[2]
            if is_face(shape, axis, l, m, n):
                age = mark_of(layer, axis, l, m, n)
                if age > 0 and age < number:
                    total += face(grown, axis, l, m, n)
                    count += 1
    if count > 0:
        put(grown, axis, i, j, k, total / float(count))
        put_mark(layer, axis, i, j, k, number)


@wp.func
def continued(field: Faces, grown: Faces, marks: Marks, axis: int, i: int, j: int, k: int):
    """The known velocity of a face, or the continued one."""
    if mark_of(marks, axis, i, j, k) >= KNOWN:
        return face(field, axis, i, j, k)
    return face(grown, axis, i, j, k)


@wp.kernel
def slide(
    shape: wp.vec3i,
    openings: Faces,
    normals: Normals,
    marks: Marks,
    field: Faces,
    grown: Faces,
    held: float,
    out: Faces,
):
    """Closed faces lose the part of the local velocity that is normal to the wall, and the share `held` of the rest."""
    axis, i, j, k = wp.tid()
    if not is_face(shape, axis, i, j, k):
        return
    v = continued(field, grown, marks, axis, i, j, k)
    if face(openings, axis, i, j, k) == 0.0:
        normal = normal_of(normals, axis, i, j, k)
        own = normal[axis]
        if own != 0.0:
            speed = own * v
            s = step(axis)
            for b in range(3):
                if b != axis and normal[b] != 0.0:
                    t = step(b)
                    high = wp.vec3i(shape[0] - 1 + t[0], shape[1] - 1 + t[1], shape[2] - 1 + t[2])
                    total = float(0.0)
                    for back in range(2):
                        for on in range(2):
                            # the four faces of component b around this face
                            l = wp.clamp(i - back * s[0] + on * t[0], 0, high[0])
                            m = wp.clamp(j - back * s[1] + on * t[1], 0, high[1])
                            n = wp.clamp(k - back * s[2] + on * t[2], 0, high[2])
                            total += continued(field, grown, marks, b, l, m, n)
                    speed += normal[b] * total * 0.25
            v -= own * speed
        v -= held * v
    put(out, axis, i, j, k, v)
