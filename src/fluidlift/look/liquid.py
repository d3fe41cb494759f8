"""A liquid's surface as a camera sees it, and the light that it sends there.

One surface per pixel: light is mirrored at it, or enters, is bent, absorbed and scattered on its way and leaves on the
far side, where the picture of what lies behind is taken (Wyman 2005, image-space refraction through two interfaces;
van der Laan, Green and Sainz 2009). Everything is linear light.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.look.environment import LEVELS, LUMINANCE, Environment
from fluidlift.look.environment_stack import stacked
from fluidlift.look.liquid_kernels import (
    BEYOND,
    COLOR,
    FARTHER,
    FREE,
    HAZE,
    INWARD,
    MIRROR,
    NUMBERS,
    OUTSIDE,
    PATH,
    SECOND,
    SHARE,
    SPREAD,
    THROUGH,
    TURNED,
    WIDE,
    follow,
    shade,
)
from fluidlift.look.liquid_lookup import SLANTED, pyramid
from fluidlift.look.materials import Material
from fluidlift.look.optics import cloud_seen, fresnel, held_inside, transmittance
from fluidlift.look.smoothstep import smoothstep
from fluidlift.types.camera import PinholeCamera

SHARP = 0.004
"""GGX's alpha up to which a mirror shows what a pixel of the environment's picture can hold"""
WAVELENGTHS = np.array([611e-9, 549e-9, 465e-9])
"""m, dominant of the primaries of sRGB"""
SECOND_RADIATION = 0.014388
"""m K, Planck's law"""
COOL, HOT = 900.0, 1430.0
"""K, of black liquid that glows and of the brightest"""
WARM = 0.62
"""how hot a colour of the usual luminance is, from `COOL` (0) to `HOT` (1)"""
CONTRAST = 1.5
"""power of the luminance over the usual one, from which heat rises towards `HOT` without ever being cut off there"""
DIM = 0.5
"""roughness at which surroundings are seen by light that is mirrored at the far side: from there it leaves through
other sides of the liquid, into many directions"""
DULL = 0.9
"""share of the reflection at grazing angles, above that straight on, that a rough surface lacks: its slopes hide each
other there"""


@dataclass(frozen=True)
class SurfaceBuffer:
    """The nearest surface of a liquid in every pixel."""

    depth: Float[np.ndarray, "h w"]
    """camera z, m; 0 where there is no liquid"""
    normal: Float[np.ndarray, "h w 3"]
    """unit, world, towards the viewer"""
    thickness: Float[np.ndarray, "h w"]
    """m of liquid along the straight line of sight"""
    albedo: Float[np.ndarray, "h w 3"]
    """linear colour that the liquid carries (of its splats)"""
    covered: Float[np.ndarray, "h w"]
    """share of the pixel, 0 to 1"""
    back_normal: Float[np.ndarray, "h w 3"] | None = None
    """unit, world, away from the liquid on its far side; None: as if the far side were parallel to the near one, and
    mirrored nothing"""
    grain: float = 0.0
    """m, height over what it lies on from which liquid is seen in full: a thinner film fades out, and its edge with it.
    0: every film is taken as it is"""

    def __post_init__(self) -> None:
        shape = self.depth.shape
        shapes = {"normal": (*shape, 3), "thickness": shape, "albedo": (*shape, 3), "covered": shape}
        if self.back_normal is not None:
            shapes["back_normal"] = (*shape, 3)
        for name, wanted in (("depth", shape), *shapes.items()):
            array = np.ascontiguousarray(getattr(self, name), np.float32)
            require(array.ndim >= 2 and array.shape == wanted, f"{name} of shape {array.shape}", str(wanted))
            object.__setattr__(self, name, array)
        require(np.isfinite(self.grain) and self.grain >= 0, f"a grain of {self.grain}", "0 m or more")


@dataclass(frozen=True)
class Behind:
    """The picture without the liquid."""

    image: Float[np.ndarray, "h w 3"]
    """linear"""
    depth: Float[np.ndarray, "h w"]
    """camera z, m; 0: infinitely far"""
    goes_on: bool = False
    """it stands for what lies beyond its rim, too: first the rim, then the mean. For the plate of a clip, around which
    nobody knows the world; else that is the environment's"""
    coarse: float = 1.0
    """px of it that were one px of what it was enlarged from: so far over its outline what it shows may reach"""
    direct: Float[np.ndarray, "h w 4"] | None = None
    """what of it is the strongest light's (linear), and the cosine under which that falls in; None: nothing"""

    def __post_init__(self) -> None:
        shape = np.shape(self.depth)
        for name, wanted in (("depth", shape), ("image", (*shape, 3))):
            array = np.ascontiguousarray(getattr(self, name), np.float32)
            require(array.ndim >= 2 and array.shape == wanted, f"{name} of shape {array.shape}", str(wanted))
            object.__setattr__(self, name, array)

    @property
    def rest(self) -> Float[np.ndarray, "5"]:
        """Linear mean of what is far away and 1, if it goes on beyond the rim, else 0; and how coarse it is."""
        if not self.goes_on:
            return np.array([0.0, 0.0, 0.0, 0.0, self.coarse])
        far = self.depth <= 0
        mean = (self.image[far] if far.any() else self.image.reshape(-1, 3)).mean(axis=0, dtype=np.float64)
        return np.array([*mean, 1.0, self.coarse])


def shaded(
    surface: SurfaceBuffer,
    behind: Behind,
    camera: PinholeCamera,
    material: Material,
    environment: Environment,
    *,
    usual: float | None = None,
    before: Float[np.ndarray, "h w 3"] | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """The finished picture: `behind`, with the liquid before it where it is nearer.

    Light mirrored at the surface comes from the environment, wider with the roughness and where the surface is
    curved within a pixel. What enters is bent after Snell, runs to the far side (of `thickness` and `back_normal` where
    the bent ray gets there), leaves it bent again and meets what lies behind, which is looked up in the picture. The
    share that is mirrored on the far side (Fresnel's, up to all of it) is followed on inside to where it gets out, and
    looked up there. Light that comes from outside the picture is the environment's. Picture and
    environment are as blurred as the light of a pixel is fanned out by both sides. On the way
    exp(-absorption d) is left; of a cloudy liquid what `optics.cloud_seen` says, with what is scattered forward, and
    the body has its own colour, lit by the environment's irradiance (`Material.albedo` is the limit of a deep body). A
    clear liquid in a uniformly white world is white, whatever its shape.

    Not there: reflections of the ground in the liquid, shadows on the liquid, caustics.

    Args:
        surface: of the liquid.
        behind: the picture without it, of the same size. What is nearer than the liquid hides it.
        camera: who looks.
        material: the liquid.
        environment: the light.
        usual: luminance (linear) of the carried colour that is `WARM`, for what glows; None: the mean of this picture.
            One number for a whole film keeps the glow of things that stay.
        before: linear, what is seen beside the liquid; None: the same that is seen through it.

    Returns:
        Linear float32.

    Raises:
        ValueError: pictures of different sizes.
    """
    _check(surface, behind, camera)
    picture = behind.image.copy() if before is None else np.array(before, np.float32)
    if usual is None:
        usual = _usual(surface, behind) if max(material.emission) > 0 else 1.0
    numbers = np.array([
        material.refractive_index, material.roughness, material.scattering, _straight(material), DULL, material.carried,
        SHARP, max(usual, 1e-6), COOL, HOT, WARM, CONTRAST, *material.absorption, *material.albedo, *material.emission,
        *LUMINANCE, *np.concatenate(material.fluxes), held_inside(float(material.refractive_index)),
    ])  # fmt: skip
    world = (*_pictures(environment), _STEPS, _DIM, SECOND_RADIATION / WAVELENGTHS)
    scene = _scene(behind, surface, bool(material.fluxes[1].any()))
    shade(_arrays(surface), scene, _eye(camera), world, numbers, picture)
    return picture


def _arrays(surface: SurfaceBuffer) -> tuple:
    back = np.zeros((0, 0, 3), np.float32) if surface.back_normal is None else surface.back_normal
    return (
        surface.covered, surface.depth, surface.normal, back, surface.thickness, surface.albedo, float(surface.grain)
    )  # fmt: skip


def _scene(behind: Behind, surface: SurfaceBuffer, cloudy: bool = True) -> tuple:
    # only where a far side is known is it known how wide its light is fanned out; a cloud scatters it as well
    return *pyramid(behind.image, deep=cloudy or surface.back_normal is not None), behind.depth, behind.rest


def shaded_plain(
    surface: SurfaceBuffer, behind: Behind, camera: PinholeCamera, material: Material, environment: Environment
) -> Float[np.ndarray, "h w 3"]:
    """What `shaded` does, in NumPy, for reading."""
    _check(surface, behind, camera)
    rows, columns = np.nonzero(_seen(surface, behind))
    picture = behind.image.copy()
    rays = followed(surface, behind, camera, np.stack([rows, columns], axis=-1), material.refractive_index)
    # slopes within a pixel widen the lobe like roughness: else they sparkle (Kaplanyan et al. 2016)
    spread = np.maximum(rays.spread - SHARP, 0.0)
    mirrored = environment.blurred(rays.mirror, (material.roughness**4 + spread**2) ** 0.25)
    # so do both sides for what comes through, or it sparkles where the sun is
    far = environment.blurred(rays.through, np.sqrt(np.maximum(rays.wide - SHARP, 0.0)))
    through = np.where(rays.surroundings[:, None], far, rays.color)
    (fade, cloud), held = material.fluxes, held_inside(float(material.refractive_index))
    path, both = rays.path[:, None], (rays.path + rays.farther)[:, None]
    second = np.where(rays.beyond[:, None], environment.blurred(rays.inward, DIM), rays.second)
    back = rays.turned[:, None]
    extinction = np.asarray(material.absorption) + material.scattering
    if cloud.any():
        # light that is scattered forward shows no sharp picture
        free = rays.free[:, None]
        straight, hazy, near = cloud_seen((fade, cloud), extinction, held, path, free)
        haze = np.where(rays.surroundings[:, None], through, rays.haze)
        inside = (1.0 - back) * (straight * through + hazy * haze)
        straight, hazy, far = cloud_seen((fade, cloud), extinction, held, both, free)
        inside += back * second * (straight + hazy)
    else:
        # the body's own colour takes the place of the light that is lost on the way
        near, far = 1.0 - transmittance(extinction, rays.path), 1.0 - transmittance(extinction, both[:, 0])
        inside = (1.0 - back) * through * (1.0 - near) + back * second * (1.0 - far)
    seen = ((1.0 - back) * near + back * far) * (material.scattering > 0)
    carried = surface.albedo[rows, columns]
    albedo = np.asarray(material.albedo, np.float32) * (1.0 - material.carried) + material.carried * carried
    inside += seen * albedo * environment.irradiance(surface.normal[rows, columns])
    inside += seen * np.asarray(material.emission, np.float32) * glow(carried, _usual(surface, behind))
    straight = _straight(material)
    share = (straight + (rays.share - straight) * (1.0 - DULL * material.roughness))[:, None]
    light = share * mirrored + (1.0 - share) * inside
    part = surface.covered[rows, columns] * film_shown(surface, behind, camera)[rows, columns]
    picture[rows, columns] += part[:, None] * (light - picture[rows, columns])
    return picture


def film_shown(surface: SurfaceBuffer, behind: Behind, camera: PinholeCamera) -> Float[np.ndarray, "h w"]:
    """Share, 0 to 1, that is seen of the liquid, from 0 where it has no height over what it lies on to 1 at its grain.

    The plane that the picture behind shows in a pixel is n . p = 1, with the slopes of its inverse depth for n (of the
    side on which it changes less): a point p lies (1 - n . p) / |n| over it.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(behind.depth > 0, 1.0 / behind.depth.astype(np.float64), np.nan)
        slopes = []
        for axis, focal in ((1, camera.focal[0]), (0, camera.focal[1])):
            room = [(1, 1) if k == axis else (0, 0) for k in (0, 1)]
            steps = np.nan_to_num(np.diff(np.pad(inverse, room, constant_values=np.nan), axis=axis), nan=np.inf)
            left, right = (
                np.moveaxis(np.moveaxis(steps, axis, 0)[cut], 0, axis) for cut in (slice(-1), slice(1, None))
            )
            slope = np.where(np.abs(left) < np.abs(right), left, right)
            slopes.append(focal * np.where(np.isfinite(slope), slope, 0.0))
        place = (camera.pixel_grid() - camera.center) / camera.focal
        along = inverse - place[..., 0] * slopes[0] - place[..., 1] * slopes[1]
        height = (1.0 - surface.depth * inverse) / np.sqrt(slopes[0] ** 2 + slopes[1] ** 2 + along**2)
        share = smoothstep(height, 0.0, surface.grain) if surface.grain > 0 else np.ones(inverse.shape)
    thick = np.isnan(inverse) | (behind.depth - surface.depth > SLANTED * surface.grain) | (surface.grain <= 0)
    return np.where(thick, 1.0, share)


def _check(surface: SurfaceBuffer, behind: Behind, camera: PinholeCamera) -> None:
    width, height = camera.size
    require(surface.depth.shape == (height, width), f"a surface of {surface.depth.shape}", f"({height}, {width})")
    require(behind.depth.shape == (height, width), f"a background of {behind.depth.shape}", f"({height}, {width})")


def _seen(surface: SurfaceBuffer, behind: Behind) -> np.ndarray:
    """bool [h,w]: the liquid is there, and nothing before it."""
    there = (surface.covered > 0) & (surface.depth > 0)
    return there & ((behind.depth <= 0) | (surface.depth < behind.depth))


def _usual(surface: SurfaceBuffer, behind: Behind) -> float:
    carried = surface.albedo[_seen(surface, behind)]
    return float((carried @ LUMINANCE).mean()) if len(carried) else 1.0


def _straight(material: Material) -> float:
    return float(fresnel(np.ones(1), material.refractive_index)[0])


def _eye(camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    lens = np.array([*camera.focal, *camera.center, *(1.0 / f for f in camera.focal)], np.float64)
    return lens, np.ascontiguousarray(camera.camera_from_world.rotation, np.float64)


_STEPS = np.array([0.0, *(roughness for roughness, _ in LEVELS)])
_DIM = int(np.argmin(np.abs(_STEPS - DIM)))


@lru_cache(maxsize=2)
def _pictures(environment: Environment) -> tuple[np.ndarray, np.ndarray]:
    """The environment, its prefiltered pictures and that of the irradiance, for `shade`."""
    pictures = [environment.between(float(roughness))[0] for roughness in _STEPS[:-1]]
    return stacked([*pictures, environment.between(1.0)[1], environment.diffuse])


@dataclass(frozen=True)
class Followed:
    """Where the light of n pixels comes from."""

    share: Float[np.ndarray, " n"]
    """mirrored, 0 to 1"""
    mirror: Float[np.ndarray, "n 3"]
    """world direction of the mirrored ray"""
    through: Float[np.ndarray, "n 3"]
    """world direction of the ray behind the liquid"""
    path: Float[np.ndarray, " n"]
    """m in the liquid"""
    surroundings: np.ndarray
    """bool [n]: what comes through is the environment's"""
    turned: Float[np.ndarray, " n"]
    """share of what comes through, 0 to 1, that was mirrored at the far side"""
    inward: Float[np.ndarray, "n 3"]
    """world direction from which that comes, outside the liquid"""
    farther: Float[np.ndarray, " n"]
    """m that it goes on in the liquid"""
    beyond: np.ndarray
    """bool [n]: it is the environment's"""
    second: Float[np.ndarray, "n 3"]
    """linear, that where it is the picture's"""
    color: Float[np.ndarray, "n 3"]
    """linear, what comes through where it is the picture's"""
    spread: Float[np.ndarray, " n"]
    """of the normals in the pixel, GGX's alpha"""
    wide: Float[np.ndarray, " n"]
    """how wide what comes through is fanned out, in the same units"""
    haze: Float[np.ndarray, "n 3"]
    """linear, the picture's mean over as far as light is scattered aside on its way; 0 where it is not the picture's"""
    free: Float[np.ndarray, " n"]
    """0, where the liquid rests on something, to 1: of the far side"""


def followed(
    surface: SurfaceBuffer, behind: Behind, camera: PinholeCamera, pixels: np.ndarray, refractive_index: float
) -> Followed:
    """Follow the light of `pixels` (int [n,2]: row, column) back through the liquid."""
    rays = np.zeros((len(pixels), NUMBERS))
    there = np.ascontiguousarray(pixels, np.int64)
    follow(there, _arrays(surface), _scene(behind, surface), _eye(camera), float(refractive_index), rays)
    r = rays.astype(np.float32)

    def three(at: int) -> np.ndarray:
        return r[:, at : at + 3]

    return Followed(
        r[:, SHARE], three(MIRROR), three(THROUGH), r[:, PATH], r[:, OUTSIDE] > 0, r[:, TURNED], three(INWARD),
        r[:, FARTHER], r[:, BEYOND] > 0, three(SECOND), three(COLOR), r[:, SPREAD],
        r[:, WIDE], three(HAZE), r[:, FREE],
    )  # fmt: skip


def glow(carried: Float[np.ndarray, "n 3"], usual: float) -> Float[np.ndarray, "n 3"]:
    """Share of the full emission, 0 to 1, of liquid with these linear colours: what is brighter than usual is hot.

    Wien's law between `COOL` and `HOT` kelvin: a cooler body is darker, and redder, as in the world.

    Args:
        carried: linear colours.
        usual: luminance of the colour that is `WARM` of the way from cool to hot.
    """
    warmth = 1.0 - (1.0 - WARM) ** ((carried @ LUMINANCE) / max(usual, 1e-6)) ** CONTRAST
    kelvin = COOL + (HOT - COOL) * warmth
    return np.exp((1.0 / HOT - 1.0 / kelvin)[:, None] * (SECOND_RADIATION / WAVELENGTHS)).astype(np.float32)
