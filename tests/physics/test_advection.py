"""Semi-Lagrangian advection: what it carries, and how exact its gradients are."""

import numpy as np
import pytest
import torch

from fluidlift.physics.advection import advect, advect_plain, everywhere, sample_trilinear

H = 0.1


def random_faces(shape=(5, 4, 3), *, size=1.0, seed=0, dtype=torch.float64):
    rng = np.random.default_rng(seed)
    faces = []
    for axis in range(3):
        full = [n + (a == axis) for a, n in enumerate(shape)]
        faces.append(torch.tensor(size * rng.standard_normal(full), dtype=dtype))
    return tuple(faces)


def smooth_faces(shape, dtype=torch.float64):
    """A gently varying field, all velocities positive (so that the upwind direction is the same everywhere)."""
    faces = []
    for axis in range(3):
        full = [n + (a == axis) for a, n in enumerate(shape)]
        x, y, z = np.meshgrid(*(np.arange(n) for n in full), indexing="ij")
        faces.append(torch.tensor(1 + 0.1 * np.sin(0.3 * x + 0.4 * y + 0.5 * z + axis), dtype=dtype))
    return tuple(faces)


def test_a_uniform_flow_stays_uniform():
    start = tuple(torch.full_like(q, value) for q, value in zip(random_faces(), (0.3, -0.2, 0.1)))
    for before, after in zip(start, advect(start, 0.5, spacing=H)):
        # weights of an interpolation add up to 1 to rounding
        torch.testing.assert_close(after, before, rtol=1e-14, atol=0)


def test_a_shear_profile_is_carried_by_whole_cells():
    u, v, w = (torch.zeros_like(q) for q in random_faces((8, 3, 3)))
    w[:] = torch.arange(8, dtype=torch.float64)[:, None, None] ** 2
    u[:] = 2 * H  # two cells in one second
    # vertical motion is too slow here to matter: the profile itself moves by two cells
    slow = 1e-12 * w
    moved = advect((u, v, slow), 1.0, spacing=H)
    torch.testing.assert_close(moved[2][2:, 1, 1], slow[:-2, 1, 1], rtol=1e-6, atol=0)


def test_trilinear_sampling_is_exact_for_linear_fields_and_clamps_outside():
    x, y, z = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (4, 5, 6)), indexing="ij")
    field = 2 * x - 3 * y + 0.5 * z + 1
    points = torch.tensor([[0.25, 3.5, 4.75], [2.9, 0.1, 0.0], [-3.0, 9.0, 2.5]], dtype=torch.float64)
    inside = torch.tensor([[0.25, 3.5, 4.75], [2.9, 0.1, 0.0], [0.0, 4.0, 2.5]], dtype=torch.float64)
    expected = 2 * inside[:, 0] - 3 * inside[:, 1] + 0.5 * inside[:, 2] + 1
    torch.testing.assert_close(sample_trilinear(field, points), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("shape", [(5, 4, 3), (1, 4, 3), (4, 1, 2)])
def test_kernel_and_plain_twin_agree_forward_and_backward(shape):
    k = torch.tensor(0.07, dtype=torch.float64)
    weights = random_faces(shape, seed=9)
    results = []
    for gradient in ("exact", "plain"):
        inputs = [q.clone().requires_grad_() for q in random_faces(shape, size=10.0)]
        step = k.clone().requires_grad_()
        out = advect(tuple(inputs), step, spacing=1.0, gradient=gradient)
        grads = torch.autograd.grad(sum((a * b).sum() for a, b in zip(out, weights)), [*inputs, step])
        results.append([*out, *grads])
    for fast, plain in zip(*results):
        # the same sums in another order
        torch.testing.assert_close(fast, plain, rtol=1e-11, atol=1e-11)


def test_exact_gradient_passes_the_float64_gradcheck():
    inputs = [q.requires_grad_() for q in random_faces((4, 3, 3), size=1.0, seed=3)]
    step = torch.tensor(0.031, dtype=torch.float64, requires_grad=True)

    def carried(u, v, w, dt):
        return advect((u, v, w), dt, spacing=H)

    # back-traced points stay clear of cell borders, where the trilinear weights have kinks
    assert torch.autograd.gradcheck(carried, (*inputs, step), eps=1e-7, atol=1e-5)


def test_faces_that_are_not_active_pass_through():
    start = random_faces()
    masks = everywhere(start)
    masks[0][:] = False
    out = advect(start, 0.1, spacing=H, active=masks)
    assert torch.equal(out[0], start[0])
    assert not torch.equal(out[1], start[1])


def surrogate_disagreement(courant):
    """Distance of the two gradients over the size of the exact one, for a random linear loss."""
    start = smooth_faces((8, 7, 6))
    weights = random_faces((8, 7, 6), seed=5)
    grads, values = [], []
    for gradient in ("exact", "upwind"):
        inputs = [q.clone().requires_grad_() for q in start]
        out = advect(tuple(inputs), courant * H, spacing=H, gradient=gradient)
        values.append(out)
        # clear of the box's border, where the one-sided differences of the surrogate are 0
        total = sum((a * b)[2:-2, 2:-2, 2:-2].sum() for a, b in zip(out, weights))
        grads.append(torch.cat([g.ravel() for g in torch.autograd.grad(total, inputs)]))
    assert all(torch.equal(a, b) for a, b in zip(*values))
    return float((grads[0] - grads[1]).norm() / grads[0].norm())


def test_upwind_surrogate_has_the_same_forward_and_a_gradient_that_drifts_away_with_the_courant_number():
    """The surrogate is not the derivative of the forward pass: an explicit upwind step weighs its stencil 1 - 3c, c, c,
    c where interpolation in three directions weighs (1 - c)^3, c (1 - c)^2, ... They differ by 3 c^2 and more: a few
    per cent at c = 0.1 per axis, as much as the gradient itself at c = 0.4, where 3 c > 1 is beyond the explicit
    step's own limit."""
    small, large = surrogate_disagreement(0.1), surrogate_disagreement(0.4)
    print(f"surrogate against exact gradient: {small:.3f} at c = 0.1, {large:.3f} at c = 0.4")
    assert 0.005 < small < 0.1
    assert large > 5 * small


def test_single_precision_kernel_follows_double_precision():
    start = random_faces((6, 5, 4), size=5.0)
    fine = advect_plain(start, torch.tensor(0.1, dtype=torch.float64))
    coarse = advect(tuple(q.float() for q in start), 0.1, spacing=1.0)
    for a, b in zip(coarse, fine):
        # values of size 5 to 15 in single precision
        torch.testing.assert_close(a.double(), b, rtol=0, atol=1e-5)


def test_an_unknown_gradient_is_refused():
    with pytest.raises(ValueError, match="gradient 'magic'"):
        advect(random_faces(), 0.1, spacing=H, gradient="magic")
