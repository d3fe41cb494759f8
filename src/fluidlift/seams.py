"""Interfaces that back ends implement: an abstract class each, with one method (the transfers have two)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np

from fluidlift.types import (
    CameraPath,
    FaceVelocity,
    Gaussians,
    Grid,
    Particles,
    PinholeCamera,
    PixelFlow,
    PixelLabels,
    SolveReport,
    TriangleMesh,
    VideoClip,
)

Tensor: TypeAlias = Any
"""a torch tensor; torch itself is not imported here, because the command line needs this module at its start"""


class Segmenter(ABC):
    """Which pixels are fluid."""

    @abstractmethod
    def segment(
        self, clip: VideoClip, flow: PixelFlow, *, out: tuple[np.ndarray, np.ndarray] | None = None
    ) -> PixelLabels:
        """Labels of every frame of the clip.

        Args:
            clip: its frames may be mapped from disk; they are read one by one.
            flow: of the clip.
            out: labels (u8 [T,H,W]) and confidence (float16 [T,H,W]) to fill, such as mapped files; None: new ones.
        """


class Generator(ABC):
    """Image to Gaussians (paper: G)."""

    @abstractmethod
    def generate(self, image: np.ndarray, mask: np.ndarray, frame: int) -> tuple[Gaussians, PinholeCamera]:
        """Canonical Gaussians and the camera that saw them.

        Args:
            image: u8 [H,W,3], sRGB.
            mask: bool [H,W], the fluid.
            frame: number of the frame in its clip.
        """


class FlowEstimator(ABC):
    """Motion of pixels between two pictures."""

    any_thread = False
    """whether several threads may ask at the same time"""

    @abstractmethod
    def displacement(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """float32 [H,W,2], px: where each pixel of `first` (u8 [H,W,3]) went in `second`."""

    def estimate(self, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """The displacement, and how far the estimator itself trusts it: float32 [H,W] from 0 to 1, or None where it
        cannot say (most cannot; a caller then has the round trip and the texture to go by)."""
        return self.displacement(first, second), None

    @property
    def halved(self) -> FlowEstimator:
        """The same at half of the resolution, in a fraction of the time, for what needs no more; itself where there is
        none."""
        return self


class DepthEstimator(ABC):
    """Distance of every pixel."""

    @abstractmethod
    def depth(self, image: np.ndarray, camera: PinholeCamera) -> np.ndarray:
        """float32 [H,W], camera z in m up to one factor, of a u8 [H,W,3] picture."""


class PoseSolver(ABC):
    """Structure from motion: poses of a camera that goes somewhere."""

    @abstractmethod
    def solve(
        self, places: np.ndarray, size: tuple[int, int], focal: float, *, told: bool = False
    ) -> CameraPath | None:
        """Poses of all frames and a sparse cloud; None where the tracks do not resolve to one scene.

        Args:
            places: float64 [n,t,2], px from the upper left corner: where each frame shows what stands; not a number
                where it does not.
            size: of the picture, px.
            focal: px, a first guess.
            told: it is known, and stays.
        """


class SplatView(Protocol):
    """A pinhole camera as plain numbers, as `numerics.splatting.SplatCamera` is: x_cam = rotation @ x + translation."""

    @property
    def rotation(self) -> np.ndarray:
        """[3,3]."""
        ...

    @property
    def translation(self) -> np.ndarray:
        """[3], m."""
        ...

    @property
    def focal(self) -> tuple[float, float]:
        """px."""
        ...

    @property
    def center(self) -> tuple[float, float]:
        """px, from the upper left corner of the picture."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """Width, height, px."""
        ...

    @property
    def near(self) -> float:
        """m of camera z; Gaussians with their centre nearer than this are not drawn."""
        ...


@dataclass(frozen=True)
class Splatted:
    """A picture of Gaussians that knows its gradients."""

    image: Tensor
    """[h,w,c], features composited front to back before black"""
    light: Tensor
    """[h,w], what is left of the light behind all Gaussians"""
    centers: Tensor
    """[n,2] or [1,n,2], px: where the centres lie in the picture; it keeps its gradient, if there is one"""

    def pull(self) -> Tensor:
        """[n,2]: after `backward`, the gradient of the loss at the centres in the picture, 1/px."""
        if self.centers.grad is None:
            raise ValueError(
                "No gradient at the centres. Needed: backward() through image or light. Do: call it first."
            )
        return self.centers.grad.reshape(-1, 2).to(self.image.device)


class Rasterizer(ABC):
    """Gaussians to a picture of any features, in one pass, with gradients to all five operands.

    Conventions are those of gsplat (see `numerics.splatting`), whatever the implementation.
    """

    @abstractmethod
    def splat(
        self, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, features: Tensor, view: SplatView
    ) -> Splatted:
        """The picture, on the device of `means`.

        Args:
            means: float32 [n,3], world, m.
            quats: [n,4], w x y z, normalised here.
            scales: [n,3], standard deviations along the axes, m.
            opacities: [n], 0 to 1.
            features: [n,c], any c: colour, depth, normal, velocity side by side.
            view: who looks.
        """


class Mesher(ABC):
    """Particles to a surface."""

    @abstractmethod
    def surface(
        self, positions: np.ndarray, radius: float, attributes: Mapping[str, np.ndarray]
    ) -> tuple[TriangleMesh, dict[str, np.ndarray]]:
        """The surface of particles, and what they carry interpolated to its vertices. The order of vertices and faces
        may differ from call to call.

        Args:
            positions: float [n,3], m.
            radius: m, half the distance between neighbours inside the fluid.
            attributes: float [n,k] by name.
        """


class GroupedByCell(Protocol):
    """The particles cell by cell, x slowest (`physics.transfer.CellOrder` is one)."""

    @property
    def order(self) -> np.ndarray:
        """int64 [n]: particle indices."""
        ...

    @property
    def start(self) -> np.ndarray:
        """int64 [cells+1]: where each cell begins in `order`."""
        ...


class ParticleTransfer(ABC):
    """Particles to the staggered grid and back (paper: `particle_map`): one operation and its transpose.

    `order`, where it is known already, may save work; the result is that of the particles as they are.
    """

    @abstractmethod
    def particles_to_grid(
        self, particles: Particles, grid: Grid, order: GroupedByCell | None = None
    ) -> tuple[FaceVelocity, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Face velocity (m/s, 0 where no particle reaches) and face masses (kg), float32."""

    @abstractmethod
    def grid_to_particles(
        self, velocity: FaceVelocity, grid: Grid, positions: np.ndarray, order: GroupedByCell | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Velocities [n,3] (m/s) and affine matrices [n,3,3] (1/s) at positions [n,3] (m), float32.

        Beyond the outer faces the outer value continues.
        """


class WallShape(Protocol):
    """What a particle can run into (`physics.boundaries.Walls` is one)."""

    @property
    def grid(self) -> Grid:
        """The box."""
        ...

    @property
    def signed_distance(self) -> np.ndarray:
        """float32 [nx+1,ny+1,nz+1], m, positive outside the solid."""
        ...

    @property
    def regions(self) -> np.ndarray:
        """u8 [nx,ny,nz], `CellType`: the sides of the box are open at INFLOW and OUTFLOW."""
        ...

    @property
    def open_sides(self) -> np.ndarray:
        """bool [3,2]: sides of the box (axis, low/high) without a wall."""
        ...


CLEARANCE = 0.02
"""cells: how far outside the solid a colliding particle is put"""
CONTACT = 0.5
"""cells: a free flight that ends closer to the wall is an impact (the pressure of its own cell would stop it there)"""


@dataclass(frozen=True)
class MoveRules:
    """How particles behave at walls, and how far they may stretch, within one step."""

    dt: float
    """s"""
    restitution: float
    """share of the normal velocity given back on impact"""
    tangential_share: float
    """of the tangential velocity that survives the step at a wall"""
    max_stretch: float
    """largest singular value of the deformation"""
    deform: bool = True
    """False: the deformation is not asked for, and may stay as it is"""


class ParticleMover(ABC):
    """The particles' own half of a step."""

    @abstractmethod
    def moved(
        self,
        particles: Particles,
        moves: np.ndarray,
        velocities: np.ndarray,
        affine: np.ndarray,
        walls: WallShape,
        rules: MoveRules,
    ) -> Particles:
        """Displaced, kept out of walls and deformed; all else unchanged.

        Args:
            particles: before the step, with the velocities that they came with.
            moves: float32 [n,3], m.
            velocities: float32 [n,3], m/s, after the step.
            affine: float32 [n,3,3], 1/s, after the step.
            walls: what they may run into.
            rules: of the step.
        """


@dataclass(frozen=True)
class Stepped:
    """What a `LiquidStepper` found in one substep."""

    farthest: float
    """m, the largest component of a displacement; not a number where one is not"""
    leaving: int
    """particles that are out of the box or the outlet now"""
    pressure: SolveReport
    viscosity: tuple[SolveReport, ...] = ()


class DeviceArray(Protocol):
    """An array that lies where a back end works; torch takes it without a copy (`torch.from_dlpack`)."""

    def __dlpack__(self, *, stream: int | None = None) -> Any:
        """See the Python array API standard."""
        ...

    def __dlpack_device__(self) -> tuple[Any, int]:
        """See the Python array API standard."""
        ...

    def numpy(self) -> np.ndarray:
        """For the host."""
        ...


@dataclass(frozen=True)
class CarriedSplats:
    """The Gaussians that particles carried at one instant (`physics.deform.deform_gaussians`), where the particles lie.

    Opacities and colours are those of the rest Gaussians of `source`, which do not change.
    """

    means: DeviceArray
    """float32 [n,3], m"""
    quats: DeviceArray
    """float32 [n,4], w x y z"""
    scales: DeviceArray
    """float32 [n,3], m"""
    source: DeviceArray
    """int64 [n]: the rest Gaussian of each"""


class LiquidStepper(ABC):
    """A liquid whose particles and grid stay where its substeps are done, such as on a GPU.

    A state is what `physics.apic.LiquidSimulator` keeps of its particles; `time` is in s of the simulation.
    """

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of particles."""

    @abstractmethod
    def upload(self, particles: Particles) -> None:
        """Replace all particles."""

    @abstractmethod
    def download(self, *, by_id: bool = False) -> Particles:
        """A copy of the particles, in their present order or in that of their ids."""

    @abstractmethod
    def splats(self, rest: Gaussians, *, max_stretch: float, max_size: float, by_id: bool = False) -> CarriedSplats:
        """The Gaussians that the particles carry now, in arrays that outlive the present state.

        Args:
            rest: the undeformed Gaussians; not to be changed between calls.
            max_stretch, max_size: see `physics.deform.deform_gaussians`.
            by_id: in the order of the ids, or in the present one.

        Raises:
            ValueError: a particle whose source is no rest Gaussian.
        """

    @abstractmethod
    def append(self, particles: Particles) -> None:
        """Put particles behind the others."""

    @abstractmethod
    def lacking(self) -> np.ndarray:
        """float64 [m,3], m: places of the inlet's lattice that lack a particle now."""

    @abstractmethod
    def carry(self, time: float) -> None:
        """Particles in the inlet move as prescribed."""

    @abstractmethod
    def max_speed(self) -> float:
        """m/s; not a number where one is not."""

    @abstractmethod
    def mass(self) -> float:
        """kg of all particles."""

    @abstractmethod
    def wet_cells(self) -> int:
        """How many cells of the box hold particles."""

    @abstractmethod
    def take_out(self, cells: np.ndarray) -> tuple[int, float]:
        """Take out the particles in marked cells (bool [nx,ny,nz]): how many they were, and kg."""

    @abstractmethod
    def prepare(self, first_id: int, draw: Callable[[int], np.ndarray] | None) -> int:
        """Begin a substep (at least one particle): particles in the order of their cells, and reseeded with `draw`.

        Args:
            first_id: of new particles.
            draw: n -> float64 [n,3], directions in which halves part, of any length; None: no reseeding now.

        Returns:
            how many particles are new.
        """

    @abstractmethod
    def step(self, dt: float, time: float) -> Stepped:
        """Find the state after `dt` (s) of the particles that `prepare` put in order; it is not adopted yet."""

    @abstractmethod
    def adopt(self) -> None:
        """The state that `step` found becomes the present one."""

    @property
    @abstractmethod
    def head_rate(self) -> tuple[tuple[int, int, int], np.ndarray] | None:
        """First cell of the last region, and there q / dt (float32, m^2/s^2): the first guess of the pressure."""

    @abstractmethod
    def restore_head_rate(self, rate: tuple[tuple[int, int, int], np.ndarray] | None) -> None:
        """Go on from such a pressure."""


class Progress(Protocol):
    """Where progress is told: a terminal, plain lines, or nowhere."""

    def stage(self, name: str, number: int, count: int) -> None:
        """A stage begins."""

    def update(self, done: int, total: int) -> None:
        """Part of the current stage is done."""

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """A stage ended."""

    def warn(self, text: str) -> None:
        """Something the user should know."""

    def say(self, text: str) -> None:
        """Something good to know, which is not kept."""


class Silence:
    """No progress at all."""

    def stage(self, name: str, number: int, count: int) -> None:
        """Nothing."""

    def update(self, done: int, total: int) -> None:
        """Nothing."""

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """Nothing."""

    def warn(self, text: str) -> None:
        """Nothing."""

    def say(self, text: str) -> None:
        """Nothing."""
