"""Warp kernels of body forces on faces (model: `physics.forces`, `physics.guidance`).

`first` is where a region begins in the whole box, on whose faces forces lie. Imported only by adapters that have found
Warp.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_faces import Faces, face, is_face, put

wp.set_module_options({"enable_backward": False})

real = wp.float64


@wp.kernel
def push(shape: wp.vec3i, velocity: Faces, gain: wp.vec3, out: Faces):
    """The velocity with the gain (m/s) of a force that is the same everywhere."""
    axis, i, j, k = wp.tid()
    if is_face(shape, axis, i, j, k):
        put(out, axis, i, j, k, face(velocity, axis, i, j, k) + gain[axis])


@wp.kernel
def push_steadily(shape: wp.vec3i, first: wp.vec3i, velocity: Faces, acceleration: Faces, dt: float, out: Faces):
    """v + a dt."""
    axis, i, j, k = wp.tid()
    if is_face(shape, axis, i, j, k):
        a = face(acceleration, axis, first[0] + i, first[1] + j, first[2] + k)
        put(out, axis, i, j, k, face(velocity, axis, i, j, k) + dt * a)


@wp.func
def share_of(rate: float, dt: float):
    """1 - exp(-rate dt)."""
    return float(real(1.0) - wp.exp(-real(rate) * real(dt)))


@wp.kernel
def guide(
    shape: wp.vec3i,
    first: wp.vec3i,
    velocity: Faces,
    rates: Faces,
    before: Faces,
    after: Faces,
    way: float,
    dt: float,
    out: Faces,
):
    """A pull towards what lies `way` from one velocity to another."""
    axis, i, j, k = wp.tid()
    if not is_face(shape, axis, i, j, k):
        return
    a, b, c = first[0] + i, first[1] + j, first[2] + k
    one = face(before, axis, a, b, c)
    target = one + way * (face(after, axis, a, b, c) - one)
    v = face(velocity, axis, i, j, k)
    put(out, axis, i, j, k, v + share_of(face(rates, axis, a, b, c), dt) * (target - v))


@wp.struct
class NudgingState:
    """Of a `guidance.Nudging`, on the faces of the whole box."""

    target: Faces
    rates: Faces
    learnt: Faces
    change: Faces
    behind: Faces
    time: Faces


@wp.kernel
def nudge(
    shape: wp.vec3i,
    first: wp.vec3i,
    velocity: Faces,
    masses: Faces,
    memory: NudgingState,
    gain: float,
    part: float,
    counts: int,
    dt: float,
    out: Faces,
):
    """A pull and the force that is learnt from it. `part`: of the way that the learnt force goes towards `gain` (1/s)
    times the pull; `counts`: 1 where this step counts in the means."""
    axis, i, j, k = wp.tid()
    if not is_face(shape, axis, i, j, k):
        return
    a, b, c = first[0] + i, first[1] + j, first[2] + k
    v, held = face(velocity, axis, i, j, k), face(masses, axis, i, j, k) > 0.0
    lag = face(memory.target, axis, a, b, c) - v
    pull = share_of(face(memory.rates, axis, a, b, c), dt) * lag
    learnt = float(face(memory.learnt, axis, a, b, c))
    if gain > 0.0 and held:
        learnt += part * (gain * pull - learnt)
        put(memory.learnt, axis, a, b, c, learnt)
    change = pull + dt * learnt
    if held and counts == 1:
        put(memory.change, axis, a, b, c, face(memory.change, axis, a, b, c) + change)
        put(memory.behind, axis, a, b, c, face(memory.behind, axis, a, b, c) + dt * lag)
        put(memory.time, axis, a, b, c, face(memory.time, axis, a, b, c) + dt)
    put(out, axis, i, j, k, v + change)
