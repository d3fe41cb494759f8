"""Fields on the faces of a staggered grid, for Warp kernels: three arrays that one launch over (axis, i, j, k) fills.

Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Faces:
    """float32 [nx+1,ny,nz], [nx,ny+1,nz], [nx,ny,nz+1]."""

    x: wp.array3d(dtype=wp.float32)
    y: wp.array3d(dtype=wp.float32)
    z: wp.array3d(dtype=wp.float32)


@wp.struct
class Normals:
    """A vector per face."""

    x: wp.array3d(dtype=wp.vec3)
    y: wp.array3d(dtype=wp.vec3)
    z: wp.array3d(dtype=wp.vec3)


@wp.struct
class Marks:
    """A byte per face."""

    x: wp.array3d(dtype=wp.uint8)
    y: wp.array3d(dtype=wp.uint8)
    z: wp.array3d(dtype=wp.uint8)


@wp.func
def is_face(shape: wp.vec3i, axis: int, i: int, j: int, k: int):
    """Whether there is such a face in a grid of `shape` cells."""
    inside = i >= 0 and j >= 0 and k >= 0 and i <= shape[0] and j <= shape[1] and k <= shape[2]
    return inside and (axis == 0 or i < shape[0]) and (axis == 1 or j < shape[1]) and (axis == 2 or k < shape[2])


@wp.func
def step(axis: int):
    """One cell along an axis."""
    return wp.vec3i(wp.where(axis == 0, 1, 0), wp.where(axis == 1, 1, 0), wp.where(axis == 2, 1, 0))


@wp.func
def face(f: Faces, axis: int, i: int, j: int, k: int):
    """The value on a face."""
    if axis == 0:
        return f.x[i, j, k]
    if axis == 1:
        return f.y[i, j, k]
    return f.z[i, j, k]


@wp.func
def put(f: Faces, axis: int, i: int, j: int, k: int, value: float):
    """Set the value on a face."""
    if axis == 0:
        f.x[i, j, k] = value
    elif axis == 1:
        f.y[i, j, k] = value
    else:
        f.z[i, j, k] = value


@wp.func
def normal_of(f: Normals, axis: int, i: int, j: int, k: int):
    """The vector on a face."""
    if axis == 0:
        return f.x[i, j, k]
    if axis == 1:
        return f.y[i, j, k]
    return f.z[i, j, k]


@wp.func
def mark_of(f: Marks, axis: int, i: int, j: int, k: int):
    """The byte on a face."""
    if axis == 0:
        return int(f.x[i, j, k])
    if axis == 1:
        return int(f.y[i, j, k])
    return int(f.z[i, j, k])


@wp.func
def put_mark(f: Marks, axis: int, i: int, j: int, k: int, value: int):
    """Set the byte on a face."""
    if axis == 0:
        f.x[i, j, k] = wp.uint8(value)
    elif axis == 1:
        f.y[i, j, k] = wp.uint8(value)
    else:
        f.z[i, j, k] = wp.uint8(value)


@wp.func
def cell_or(cells: wp.array3d(dtype=wp.uint8), i: int, j: int, k: int, outside: int):
    """The byte of a cell, `outside` beyond the sides of the box."""
    if i < 0 or j < 0 or k < 0 or i >= cells.shape[0] or j >= cells.shape[1] or k >= cells.shape[2]:
        return outside
    return int(cells[i, j, k])
