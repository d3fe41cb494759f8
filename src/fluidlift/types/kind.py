"""Kinds of fluid: what each one is, and what is usual for it. All other code asks these values, never a name.

To add a kind: one entry in `KINDS`, and `shape/kinds/NAME.py` with the construction of its body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from fluidlift.errors import InputRejected, require

LOOKING_DOWN = (42.0, 14.0)
"""degrees, mean and standard deviation of the pitch of a camera that looks down on a fluid: 22 to 55 in eight clips"""
STRAIGHT_DOWN = (88.0, 5.0)
"""the same of drones and cameras on a stand over a table: 85 and 88 in two clips"""
STRAIGHT = 0.25
"""share of the latter (two of ten, one added to each)"""
STEEPEST_STREAM = 50.0
"""degrees; what is steeper is a fall, or something that was taken for a stream"""


@dataclass(frozen=True)
class FluidKind:
    """One kind of fluid: questions of physics, and the priors that a single view needs.

    Raises:
        ValueError: a prior without a width, or a fluid that is in the air and runs over ground at once.
    """

    name: str
    """what users type and files hold"""
    pitch_prior: tuple[float, float]
    """degrees, mean and standard deviation of how far people tilt a camera down at it from beside (a choice, not a law,
    where nothing else is said)"""
    kinematic_viscosity: float
    """m^2/s, where the fit starts"""
    wall_damping: float
    """share of the tangential velocity that a wall takes per step of the fit, where the fit starts: water runs nearly
    free over a bed that the grid cannot resolve. A viscous film does not: it sticks (`pipeline.stages.fit.sticking`)"""
    wall_layer: float
    """Thickness of the boundary layer at a wall, cells (`motion.bed.layer_thickness`). Water is turbulent: beside the
    bed of a river some 10 cells deep its speed at half a cell is about 0.7 of the surface speed (1/7 power law), which
    a layer of one cell gives; films from a fall are shorter. What is poured is often viscous and drags through its
    depth. In smoke the layer stays below half a cell and so damps nothing (paper: "sub-cell scale")."""
    looked_down_on: float = 0.0
    """share of clips that look down on it instead (`LOOKING_DOWN`): into a vessel, from a bridge, from a drone"""
    is_gas: bool = False
    """smoke: buoyant, without a free surface, seen within instead of at its surface; it passes through obstacles"""
    airborne: bool = False
    """free in the air: its body has a far side, and no ground bears it"""
    is_channel_flow: bool = False
    """open-channel flow: runs over ground, in at one open end and out at the other. It is steady, and turbulent: its
    speed is nearly the same at all depths but for a layer at the walls; it can be made longer"""
    is_standing_water: bool = False
    """stays where it is: lies on ground, and nothing flows in or out in the mean. So its surface is a level plane in
    the mean, and its mean motion runs in circles within its outline. What travels over it are waves"""
    rises_from_pool: bool = False
    """thrown up out of the pool that it falls back into: the pool stays, and what is in the air passes through it"""
    starts_at_rest: bool = False
    """a body that stands until it is let go: its shape is known as it stands, not as it collapses"""
    fills_vessel: bool = False
    """what it falls into may be a vessel that holds it: glass, whose level rises"""
    energy_share: float | None = None
    """share of the drop's energy that is left to what falls freely: almost all in the air, a third over rock (a
    choice); None: it does not fall freely"""
    depth_ratio: float | None = None
    """greatest depth over full width of what lies on ground: a single view does not show the bed (a choice;
    --depth-ratio overrides). None: it lies on none"""
    sizes: tuple[float, float] = (1.0, 1.0)
    """m across what is seen of it, where nothing tells: filmed from beside, and looked down on. Its weight against its
    motion goes with it (similarity after Froude): a river of 1 m runs level, and out of its bed, far too fast"""
    surveyed_level: tuple[str, str] | None = None
    """entry of a camera file with the height (m) of the plane under a surveyed camera, and that plane in a message;
    None: there is no such plane"""
    recognised: bool = False
    """whether the evidence of a clip is weighed for it (`shape.kind.estimate_kind`); else only a user chooses it"""

    def __post_init__(self) -> None:
        require(self.pitch_prior[1] > 0, f"a pitch prior {self.pitch_prior} of the kind '{self.name}'", "a width > 0")
        share = self.looked_down_on
        require(0.0 <= share < 1.0, f"a share {share} of the kind '{self.name}' that is looked down on", "0 to below 1")
        both = self.airborne + self.is_channel_flow + self.is_standing_water
        require(both <= 1, f"the kind '{self.name}' in the air, in a channel and at rest in a basin", "one of them")
        require(
            self.is_standing_water or not self.rises_from_pool,
            f"the kind '{self.name}' out of a pool",
            "one that stays",
        )
        require(
            self.lies_on_ground == (self.depth_ratio is not None), f"the kind '{self.name}'",
            "a depth_ratio where it lies on ground, and only there",
        )  # fmt: skip

    def __str__(self) -> str:
        """The name, as messages say it."""
        return self.name

    @property
    def pitch_habits(self) -> tuple[tuple[float, float, float], ...]:
        """Share, mean and standard deviation (degrees) of how people film it: from beside, looking down, from above."""
        down = self.looked_down_on
        beside = (1.0 - down, *self.pitch_prior)
        if not down:
            return (beside,)
        return beside, (down * (1.0 - STRAIGHT), *LOOKING_DOWN), (down * STRAIGHT, *STRAIGHT_DOWN)

    @property
    def usual_pitch(self) -> tuple[float, float]:
        """Mean and standard deviation of all its habits together, degrees."""
        mean = sum(w * m for w, m, _ in self.pitch_habits)
        return mean, sum(w * (s**2 + (m - mean) ** 2) for w, m, s in self.pitch_habits) ** 0.5

    def usual_size(self, pitch: float) -> float:
        """M across it for a camera that looks so many degrees down: the mean of the logarithms of `sizes`, each weighed
        by how likely people film so."""
        shares = [w / s * math.exp(-0.5 * ((pitch - m) / s) ** 2) for w, m, s in self.pitch_habits]
        beside = shares[0] / max(sum(shares), 1e-300)
        return self.sizes[0] ** beside * self.sizes[1] ** (1.0 - beside)

    @property
    def falls_freely(self) -> bool:
        """Whether gravity alone sets its speed, so that 9.81 m/s^2 gives its size."""
        return self.energy_share is not None

    @property
    def enters_over_rim(self) -> bool:
        """A free overfall: a channel flow that comes in over a rim and falls along its bed."""
        return self.is_channel_flow and self.falls_freely

    @property
    def lies_on_ground(self) -> bool:
        """Whether a bed bears it and its surface is a height over that: it runs in a channel, or stands in a basin."""
        return self.is_channel_flow or self.is_standing_water

    @property
    def nearly_level(self) -> bool:
        """Whether its surface is a plane close to level."""
        return self.lies_on_ground and not self.falls_freely

    @property
    def is_level_throughout(self) -> bool:
        """Whether all of it is such a plane, and nothing of it stands in the air."""
        return self.nearly_level and not self.rises_from_pool

    @property
    def is_still_water(self) -> bool:
        """Whether what travels over it are waves alone, and no current."""
        return self.is_standing_water and not self.rises_from_pool

    @property
    def runs_nearly_level(self) -> bool:
        """A channel flow whose surface is a plane close to level: the perspective of its motion shows the tilt."""
        return self.is_channel_flow and self.nearly_level

    @property
    def is_driven_in_sight(self) -> bool:
        """Whether what drives it (its weight on a slope, its fall, its buoyancy) is in the equations that are fitted. A
        body that stands shows no motion yet; wind, a spoon or a flame under standing water are not seen."""
        return not (self.starts_at_rest or self.is_standing_water)

    @property
    def has_mean_motion(self) -> bool:
        """Whether the mean over a clip says what moves in each frame: what grows or collapses has no mean motion."""
        return not (self.is_gas or self.starts_at_rest)


STREAM = FluidKind(
    "stream", pitch_prior=(10.0, 9.0), looked_down_on=0.35, kinematic_viscosity=1e-5, wall_damping=0.05, wall_layer=1.0,
    is_channel_flow=True, depth_ratio=0.2, sizes=(10.0, 1.0), surveyed_level=("water_level_z", "the water stands"),
    recognised=True,
)  # fmt: skip
"""rivers, brooks, puddles. Pitch over a landscape, by horizon or far shore of 14 real clips (read by hand, one of
them surveyed): 2 to 29, mean 10, deviation 9; 8 of 22 clips look down. Over landscapes 12 real ones are, by eye, 8 to
300 m across, six falls 3 to 300: 10 m was tried (a torrent's current and level gain by it), and errs less than 1"""
FALL = FluidKind(
    "fall", pitch_prior=(8.0, 8.0), kinematic_viscosity=1e-5, wall_damping=0.05, wall_layer=0.75,
    is_channel_flow=True, depth_ratio=0.1, energy_share=0.35, sizes=(10.0, 1.0), recognised=True,
)  # fmt: skip
"""waterfalls, curtains over rock"""
POUR = FluidKind(
    "pour", pitch_prior=(8.0, 8.0), looked_down_on=0.35, kinematic_viscosity=1e-4, wall_damping=0.2, wall_layer=2.0,
    airborne=True, fills_vessel=True, energy_share=0.95, recognised=True,
)  # fmt: skip
"""jets in the air, and the pool that they fall into"""
PLUME = FluidKind(
    "plume", pitch_prior=(2.0, 6.0), kinematic_viscosity=1e-5, wall_damping=0.02, wall_layer=0.4,
    is_gas=True, airborne=True, recognised=True,
)  # fmt: skip
"""smoke, steam"""
DAM = FluidKind(
    "dam", pitch_prior=(25.0, 12.0), kinematic_viscosity=1e-5, wall_damping=0.05, wall_layer=1.0,
    starts_at_rest=True, surveyed_level=("ground_level_z", "the ground lies"), recognised=True,
)  # fmt: skip
"""a column of liquid that is let go (dam break)"""
BASIN = FluidKind(
    "basin", pitch_prior=(10.0, 9.0), looked_down_on=0.5, kinematic_viscosity=1e-5, wall_damping=0.05, wall_layer=1.0,
    is_standing_water=True, depth_ratio=0.2, sizes=(10.0, 1.0), surveyed_level=("water_level_z", "the water stands"),
    recognised=True,
)  # fmt: skip
"""water that stays: sea, lake, pool, pot, cup. Over a landscape people film it as they film a river; as often they
look down into a vessel (a choice)"""
FOUNTAIN = FluidKind(
    "fountain", pitch_prior=(8.0, 8.0), kinematic_viscosity=1e-5, wall_damping=0.05, wall_layer=1.0,
    is_standing_water=True, rises_from_pool=True, depth_ratio=0.1, sizes=(5.0, 1.0),
    surveyed_level=("water_level_z", "the water stands"), recognised=True,
)  # fmt: skip
"""jets that rise out of a pool and fall back into it. People film them as they film falls, from beside. Half of the
jets in parks rise by less than some 3 m, their pools are twice as wide (a choice); basins are shallow"""

KINDS: dict[str, FluidKind] = {kind.name: kind for kind in (STREAM, FALL, POUR, PLUME, DAM, BASIN, FOUNTAIN)}
"""by name; the classifier, the command line and the reader of assets go through it"""

if TYPE_CHECKING:
    KindChoice = str
else:
    KindChoice = Literal[("auto", *KINDS)]
"""what a user may say: one of the names, or auto, which decides from evidence"""


def kind_of(kind: str | FluidKind) -> FluidKind:
    """The kind of a name; a kind is returned as it is.

    Raises:
        InputRejected: an unknown name.
    """
    if isinstance(kind, FluidKind):
        return kind
    if kind not in KINDS:
        raise InputRejected(f"the kind of fluid '{kind}'", "one of " + ", ".join(KINDS))
    return KINDS[kind]
