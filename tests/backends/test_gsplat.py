"""gsplat behind the seam: its conventions, by a stand-in of its published formulas and, where installed, by itself."""

import sys
import types

import numpy as np
import pytest
import torch

from fluidlift.backends import gsplat_rasterizer
from fluidlift.backends.gsplat_rasterizer import GsplatRasterizer, best_rasterizer
from fluidlift.errors import FluidliftError, MissingPackage
from fluidlift.numerics import splatting
from fluidlift.numerics.splatting import SplatCamera
from fluidlift.numerics.splatting_colors_torch import view_colors
from fluidlift.numerics.splatting_torch import NumbaRasterizer


def scene(count: int = 60, channels: int = 10) -> tuple[SplatCamera, list[torch.Tensor]]:
    """A camera off the axis of anything, and Gaussians beside, behind and before it."""
    rng = np.random.default_rng(0)
    angle = 0.3
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    view = SplatCamera(turn, np.array([0.2, -0.1, 2.5]), (40.0, 36.0), (17.0, 11.5), (30, 22), near=0.2)
    means = rng.normal(size=(count, 3)) * (0.8, 0.6, 0.4)
    means[0], means[1] = (0, 0, -4), (3, 0, 0)
    arrays = means, rng.normal(size=(count, 4)), 0.15 * np.exp(0.5 * rng.normal(size=(count, 3)))
    arrays += rng.uniform(0.003, 1.0, count), rng.normal(size=(count, channels))
    return view, [torch.tensor(np.float32(a), requires_grad=True) for a in arrays]


def published(means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane, far_plane, eps2d,
              sh_degree, packed, tile_size, render_mode, rasterize_mode, camera_model):  # fmt: skip
    """gsplat.rasterization as its sources say (1.5.3: ProjectionEWA3DGSFused.cu, RasterizeToPixels3DGSFwd.cu)."""
    assert (sh_degree, packed, tile_size, render_mode, rasterize_mode) == (None, False, 16, "RGB", "classic")
    assert camera_model == "pinhole" and viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3)
    n = len(means)
    assert quats.shape == (n, 4) and scales.shape == (n, 3) and opacities.shape == (n,) and colors.shape[0] == n
    world, K = viewmats[0].double(), Ks[0].double()
    q = quats.double() / quats.double().norm(dim=1, keepdim=True)
    w, v = q[:, :1, None], q[:, 1:]
    cross = torch.zeros(n, 3, 3, dtype=torch.float64)
    cross[:, 2, 1], cross[:, 0, 2], cross[:, 1, 0] = v[:, 0], v[:, 1], v[:, 2]
    cross = cross - cross.transpose(1, 2)
    turn = torch.eye(3, dtype=torch.float64) + 2 * w * cross + 2 * cross @ cross  # Rodrigues
    covariance = turn @ torch.diag_embed(scales.double() ** 2) @ turn.transpose(1, 2)
    x = means.double() @ world[:3, :3].T + world[:3, 3]
    s = world[:3, :3] @ covariance @ world[:3, :3].T
    z = x[:, 2]
    tan = torch.tensor([0.5 * width, 0.5 * height]) / torch.stack([K[0, 0], K[1, 1]])
    J = torch.zeros(n, 2, 3, dtype=torch.float64)
    for a, size in ((0, width), (1, height)):
        high = (size - K[a, 2]) / K[a, a] + 0.3 * tan[a]
        low = -(K[a, 2] / K[a, a] + 0.3 * tan[a])
        J[:, a, a] = K[a, a] / z
        J[:, a, 2] = -K[a, a] * torch.clamp(x[:, a] / z, low, high) / z
    flat = J @ s @ J.transpose(1, 2) + eps2d * torch.eye(2, dtype=torch.float64)
    conics = torch.linalg.inv(flat)
    uv = (x @ K.T)[:, :2] / z[:, None]
    centers = uv.float()[None]
    at = centers[0].double()
    v_, u_ = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    transmittance = torch.ones(height, width, dtype=torch.float64)
    done = torch.zeros(height, width, dtype=torch.bool)
    image = torch.zeros(height, width, colors.shape[1], dtype=torch.float64)
    for i in torch.argsort(z.float(), stable=True).tolist():
        if not near_plane <= float(z[i].detach()) <= far_plane or float(opacities[i].detach()) < 1 / 255:
            continue
        dx, dy = at[i, 0] - u_, at[i, 1] - v_
        sigma = 0.5 * (conics[i, 0, 0] * dx * dx + conics[i, 1, 1] * dy * dy) + conics[i, 0, 1] * dx * dy
        alpha = torch.clamp(opacities[i].double() * torch.exp(-sigma), max=0.999)
        alpha = torch.where((sigma < 0) | (alpha < 1 / 255), torch.zeros_like(alpha), alpha)
        following = transmittance * (1 - alpha)
        done = done | (following <= 1e-4)
        weight = torch.where(done, torch.zeros_like(alpha), alpha * transmittance)
        image = image + weight[..., None] * colors[i].double()
        transmittance = torch.where(done, transmittance, following)
    return image.float()[None], (1 - transmittance).float()[None, ..., None], {"means2d": centers}


@pytest.fixture
def stand_in(monkeypatch):
    """gsplat's name with its published formulas behind it, on the CPU."""
    module = types.SimpleNamespace(rasterization=published)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    monkeypatch.setattr(gsplat_rasterizer, "_cuda", lambda name: torch.device("cpu"))
    return module


def drawn_with_gradients(rasterizer, view, operands):
    splatted = rasterizer.splat(*operands, view)
    rng = torch.Generator().manual_seed(1)
    push = torch.randn(splatted.image.shape, generator=rng)
    fade = torch.randn(splatted.light.shape, generator=rng)
    gradients = torch.autograd.grad(
        (splatted.image * push).sum() + (splatted.light * fade).sum(), [*operands, splatted.centers]
    )
    return splatted, gradients


def test_the_cpu_draws_what_gsplats_formulas_say_with_the_same_gradients(stand_in):
    view, operands = scene()
    ours, gradients = drawn_with_gradients(NumbaRasterizer(), view, operands)
    theirs, expected = drawn_with_gradients(GsplatRasterizer(), view, operands)
    # float32 on one side, an exponential good to 3e-6, features of size 1
    assert (ours.image - theirs.image).abs().max() < 3e-5
    assert (ours.light - theirs.light).abs().max() < 3e-5
    assert float(theirs.light.detach().min()) < 0.05, "the scene must be worth comparing"
    for name, one, other in zip(("means", "quats", "scales", "opacities", "features", "centers"), gradients, expected):
        assert (one.reshape(other.shape) - other).norm() < 1e-4 * other.norm(), name


def test_gsplat_itself_draws_what_the_cpu_does_with_the_same_gradients():
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    if not torch.cuda.is_available():
        pytest.skip("gsplat draws on an NVIDIA GPU; torch sees none")
    view, operands = scene(2000)
    ours, gradients = drawn_with_gradients(NumbaRasterizer(), view, operands)
    theirs, expected = drawn_with_gradients(GsplatRasterizer(), view, operands)
    # one Gaussian more or less at the cut of 1/255, and an exponential good to 3e-6
    assert (ours.image - theirs.image.cpu()).abs().max() < 1e-2
    assert (ours.image - theirs.image.cpu()).abs().mean() < 1e-4
    for name, one, other in zip(("means", "quats", "scales", "opacities", "features", "centers"), gradients, expected):
        assert (one.reshape(other.shape) - other.cpu()).norm() < 1e-2 * other.norm(), name


def test_the_pull_at_the_centres_is_there_whoever_draws(stand_in):
    view, operands = scene(20)
    pulls = []
    for rasterizer in (NumbaRasterizer(), GsplatRasterizer()):
        splatted = rasterizer.splat(*operands, view)
        with pytest.raises(ValueError, match="backward"):
            splatted.pull()
        splatted.image.square().sum().backward()
        pulls.append(splatted.pull())
    assert pulls[0].shape == (20, 2)
    assert (pulls[0] - pulls[1]).norm() < 1e-4 * pulls[1].norm()


def test_broken_gaussians_spoil_nothing_on_either_side(stand_in):
    view, operands = scene(30)
    broken = [x.detach().clone() for x in operands]
    broken[0][3, 1], broken[1][4] = torch.nan, torch.inf
    broken[2][5, 0], broken[3][6], broken[4][7, 2] = torch.nan, torch.nan, torch.nan
    keep = torch.tensor([k for k in range(30) if k not in (3, 4, 5, 6, 7)])
    clean = NumbaRasterizer().splat(*(x.detach()[keep] for x in operands), view)
    drawn = GsplatRasterizer().splat(*broken, view)
    assert (drawn.image - clean.image).abs().max() < 3e-5
    leaves = [x.requires_grad_() for x in broken]
    gradients = torch.autograd.grad(GsplatRasterizer().splat(*leaves, view).image.sum(), leaves)
    assert all(torch.isfinite(g).all() for g in gradients)


def test_without_gsplat_the_message_names_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(MissingPackage, match="pip install gsplat"):
        best_rasterizer("gsplat")


def test_without_a_gpu_the_message_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=published))
    monkeypatch.setattr(gsplat_rasterizer, "_gpus", lambda: 0)
    with pytest.raises(FluidliftError, match="torch sees no GPU"):
        best_rasterizer("gsplat")
    assert isinstance(best_rasterizer("auto"), NumbaRasterizer)
    with pytest.raises(ValueError, match="device 'mps'"):
        GsplatRasterizer("mps")


def test_a_build_that_failed_is_told_with_its_remedy_and_auto_takes_the_cpu(stand_in, monkeypatch):
    def failing(*_, **__):
        raise ImportError("gsplat_cuda.so: cannot open shared object file")

    stand_in.rasterization = failing
    monkeypatch.setattr(gsplat_rasterizer, "_gpus", lambda: 1)
    with pytest.raises(FluidliftError, match=r"cannot open shared object.*nvcc.*pip install gsplat"):
        best_rasterizer("gsplat")
    said = []
    assert isinstance(best_rasterizer("auto", said.append), NumbaRasterizer)
    assert len(said) == 1 and "nvcc" in said[0]
    stand_in.rasterization = published
    assert isinstance(best_rasterizer("auto"), GsplatRasterizer)


def test_other_names_are_refused():
    with pytest.raises(ValueError, match="auto, cpu or gsplat"):
        best_rasterizer("opengl")


def test_projection_is_that_of_gsplats_own_torch_reference():
    reference = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed")
    view, operands = scene(200)
    means, quats, scales, opacities, _ = (x.detach() for x in operands)
    covariances, _ = reference._quat_scale_to_covar_preci(quats, scales, True, False)
    world, K = (torch.from_numpy(m)[None] for m in gsplat_rasterizer._matrices(view))
    radii, uv, depths, conics, _ = reference._fully_fused_projection(
        means, covariances, world, K, *view.size, eps2d=0.3, near_plane=view.near
    )
    ours = splatting.project(view, *(x.numpy() for x in (means, quats, scales, opacities)))
    drawn = ours.extents[:, 0] > 0
    assert drawn.sum() > 100 and ((radii[0] > 0).all(1).numpy() | ~drawn).all(), "whatever we draw, gsplat draws"
    # float32 on both sides, positions of tens of px
    np.testing.assert_allclose(ours.means[drawn], uv[0].numpy()[drawn], atol=2e-4)
    np.testing.assert_allclose(ours.conics[drawn], conics[0].numpy()[drawn], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(ours.depths[drawn], depths[0].numpy()[drawn], rtol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_are_those_of_gsplats_own_torch_reference(degree):
    reference = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed")
    rng = torch.Generator().manual_seed(degree)
    means, eye = torch.randn(50, 3, generator=rng), torch.tensor([0.2, -3.0, 1.0])
    sh = torch.randn(50, (degree + 1) ** 2, 3, generator=rng)
    theirs = (reference._spherical_harmonics(degree, means - eye, sh) + 0.5).clamp(min=0)
    assert (view_colors(means, sh, eye.numpy()) - theirs).abs().max() < 1e-5  # float32 sums of 16
