"""What the command line can be told: one class per command, one field per option."""

from __future__ import annotations

from dataclasses import field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from fluidlift.cli.quantities import Degrees, Metres, Seconds, command
from fluidlift.types.kind import KindChoice

Clip = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CLIP")]
Asset = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ASSET")]


@command
class SceneOptions:
    """What the clip does not say by itself."""

    kind: KindChoice | None = None
    """what the fluid does; auto decides from evidence that the report shows"""
    size: Metres | None = None
    """across the fluid (its longest side), such as 0.3 or 30cm; sets the scale"""
    fov: Degrees | None = None
    """field of view across the longer side; else the file's lens metadata, else 50"""
    pitch: Degrees | None = None
    """by which the camera looks below the horizon"""
    roll: Degrees | None = None
    """by which the picture is turned clockwise"""


@command
class PartOptions:
    """Which part of the clip."""

    start: Seconds | None = None
    """where in the clip it begins, such as 12 or 12s; by default at its first frame"""
    duration: Seconds | None = None
    """how much of it is used; by default all; of a longer clip than read.max_frames frames a part that is like it"""
    fps: float | None = None
    """frames per second of an image sequence"""


@command
class MakePartOptions(PartOptions):
    """Which part of the clip."""

    shots: Literal["auto"] | None = None
    """auto: a clip with cuts becomes an asset for each of its shots, OUT_01.fluid, OUT_02.fluid, ...; by default its
    longest one is made"""


@command
class InputOptions:
    """Files beside the clip."""

    mask: Path | None = None
    """where the fluid is: one picture, a folder of pictures or a video; white is fluid"""
    camera: Path | None = None
    """camera JSON: width, height, K, and R, t where the pose is known"""
    depth: Path | None = None
    """depth map of the first used frame, or of all (EXR, 16-bit PNG, npz): replaces the estimated front depth"""
    flow: Path | None = None
    """optical flow of the clip, made elsewhere: a folder or pattern of .flo, .exr, .npz or KITTI .png, or one .npz"""


@command
class MakeInputOptions(InputOptions):
    """Files beside the clip."""

    hints: Path | None = None
    """hints.yaml: mask, horizon, ruler, kind and more as you know them (docs/hints.md; fluidlift hints begins one)"""


@command
class LearnedOptions:
    """Learned models, which see some things better."""

    models: str | None = None
    """learned models of your cache: none (the default), auto (what is there and helps), or names with commas between
    them (`fluidlift models`)"""
    use: Literal["research", "commercial"] | None = None
    """what the result is for; a model or a generator whose terms forbid that is refused"""


@command
class BodyOptions(LearnedOptions):
    """Learned models, or a body that something else made."""

    depth_model: Literal["none", "moge", "moge-onnx", "depth-anything", "depth-anything-3", "depth-pro"] | None = None
    """learned depth, moge advised; it needs --depth-weights (docs/depth.md)"""
    depth_weights: Path | None = None
    """file or folder of the weights of --depth-model, or model:NAME of your cache"""
    geometry_from: Path | None = None
    """folder of Gaussian PLY files and camera.json: replaces the embedded generator"""
    generator: str | None = None
    """third-party generator that makes the body of each frame, such as triposplat; `fluidlift generators` lists them"""
    generator_python: Path | None = None
    """Python of the environment in which the generator is installed; by default this one"""
    generator_code: Path | None = None
    """folder of the generator's own code, where that is a checkout and not installed"""
    accept_licence: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """name of a generator whose licence you have read and accept; remembered; may be repeated"""


@command
class QualityOptions:
    """How fine, and how repeatable."""

    preset: Literal["draft", "standard", "hero", "paper"] | None = None
    """draft (the default): minutes on a laptop; standard: finer; hero: as fine as the machine allows; paper: as fine as
    draft, by the method of the paper throughout, to compare with"""
    max_size: int | None = None
    """longer side of the working pictures, px"""
    seed: int | None = None
    """same clip, settings and seed: same asset"""


@command
class Settings:
    """Everything that has no option of its own."""

    config: Path | None = None
    """YAML file with settings"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one setting, such as --set fit.max_seconds=60; may be repeated"""
    force: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """run this stage and all after it again; may be repeated"""
    print_config: bool = False
    """show the settings and stop"""


MOVED = {"max_pixels": "read.max_pixels", "max_frames": "read.max_frames"}
"""options of `make` that are settings now; they are understood as before and stand no longer in its help"""


@command
class Make:
    """Turn a clip into a fluid asset."""

    clip: Clip
    """a video, a folder of pictures or a pattern such as frames/%04d.png"""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """asset folder to write; by default the clip's name with .fluid, in the current folder"""
    json: bool = False
    """print the outcome as JSON"""
    warnings_ok: bool = False
    """end with 0 instead of 4 where the asset has warnings"""
    input: tyro.conf.OmitArgPrefixes[MakeInputOptions] = field(default_factory=MakeInputOptions)
    """files beside the clip; what is not given is estimated"""
    scene: tyro.conf.OmitArgPrefixes[SceneOptions] = field(default_factory=SceneOptions)
    """what you know of the fluid and of the camera"""
    part: tyro.conf.OmitArgPrefixes[MakePartOptions] = field(default_factory=MakePartOptions)
    """which part of the clip"""
    quality: tyro.conf.OmitArgPrefixes[QualityOptions] = field(default_factory=QualityOptions)
    """how fine"""
    body: tyro.conf.OmitArgPrefixes[BodyOptions] = field(default_factory=BodyOptions)
    """learned models, or a body that something else made"""
    settings: tyro.conf.OmitArgPrefixes[Settings] = field(default_factory=Settings)
    """all else: --print-config lists every setting, such as read.max_pixels (docs/cli.md)"""


@command
class Sim:
    """Simulate a finished asset again, with its scene.yaml: longer, other frames, another liquid, obstacles."""

    asset: Asset
    """asset folder"""
    duration: Seconds | None = None
    """by default what scene.yaml says, else as long as the clip; a longer one continues what is there"""
    fps: float | None = None
    """frames per second; by default those of the clip"""
    extend_downstream: Metres | None = None
    """by which the channel of a stream or a fall goes on behind its outlet"""
    meshes: Path | None = None
    """folder of the mesh files that scene.yaml names; by default the asset"""
    resume: bool = False
    """insist on going on from the checkpoint: without one that fits, stop instead of starting again"""
    restart: bool = False
    """start at the first frame, although a checkpoint fits"""
    checkpoint_every: int | None = None
    """frames between checkpoints (10)"""
    seed: int | None = None
    """of the inflow's variation; by default that of the asset"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one setting of simulate or show, such as --set simulate.max_particles=300000; may be repeated"""
    json: bool = False
    """print the outcome as JSON"""


@command
class Fit:
    """Fit the physical parameters of a finished asset again; fluidlift sim then plays the new values."""

    asset: Asset
    """asset folder, with the work/ folder that make left"""
    method: Literal["lm", "adam"] | None = None
    """lm: Levenberg-Marquardt (the default); adam: as in the paper, slower"""
    free: str | None = None
    """parameters to fit, with commas between them, such as gravity,viscosity; by default all that the clip can tell"""
    hold: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """a value that is known, such as --hold viscosity=1e-6; it is not fitted; may be repeated"""
    restarts: int | None = None
    """further fits from other initial values, 4 at most, whose spread is reported"""
    max_seconds: Seconds | None = None
    """that the fit may take; by default as in make"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one setting of fit, such as --set fit.method=adam; may be repeated"""
    json: bool = False
    """print the outcome as JSON"""


@command
class Render:
    """Draw a finished asset from any camera: a film, or pictures with transparency or depth."""

    asset: Asset
    """asset folder"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """a film (.mp4, .mov), or a folder for pictures (numbers from 1001)"""
    view: str = "input"
    """input, side, top, turn (once around), or a JSON file: a camera, or keyed views"""
    size: str | None = None
    """width and height in px, such as 1920x1080; by default those of the clip"""
    frames: str | None = None
    """first and last, such as 1001-1024; by default all"""
    background: Literal["auto", "plate", "terrain", "none"] = "auto"
    """plate: the clip without its fluid (view input only); terrain: bed and sky; none: transparent"""
    format: Literal["png", "exr"] = "png"
    """of pictures: png (8 bits, alpha), exr (linear, alpha, camera depth in metres)"""
    look: str | None = None
    """splats (as lifted), relit, transparent, surface; by default as scene.yaml says"""
    material: str | None = None
    """of the other looks: source (the clip's colours), water, muddy_water, honey, lava, milk, oil, chocolate"""
    environment: str | None = None
    """their light: sky, studio, white, or a .hdr or .exr file"""
    exposure: float | None = None
    """stops by which they are brightened"""
    engine: str = "mesh"
    """of the look surface: mesh; screen (faster, softer); mitsuba (path tracing, for final frames)"""
    samples: int = 64
    """light paths per pixel, of mitsuba"""
    draft: bool = False
    """to try looks in half of the time: rough edges, softer shadows, a coarser surface; 8 samples of mitsuba"""
    json: bool = False
    """print the outcome as JSON"""


@command
class Export:
    """Write files of a finished asset for other tools: meshes, splats, volumes, USD, glTF, a page to share."""

    asset: Asset
    """asset folder"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for the files (numbers from 1001); a name that ends in .html will do for a page"""
    to: str = "mesh"
    """mesh (surface, PLY with colours and velocities), obj, splats (PLY), spz (small splats), gltf (one frame, GLB),
    html (a page that plays offline), vdb (velocity, density, level set), usd (one file with surface, splats, terrain
    and camera), usd-clips (a file per frame), camera (JSON), flow (EXR), flo, masks (PNG). White water is in each of
    them that shows the fluid"""
    up_axis: Literal["z", "y"] = "z"
    """of mesh, obj, splats and usd; the others have their own"""
    meters_per_unit: float = 1.0
    """of mesh, obj, splats and usd, such as 0.01 for centimetres; the others have their own"""
    frames: str | None = None
    """first and last, such as 1001-1024; by default all"""
    fps: float | None = None
    """frames per second of the files: those of the asset over a whole number; every second, third ... frame is taken"""
    json: bool = False
    """print the outcome as JSON"""


@command
class Inspect:
    """Tell what a clip is, and what `make` would warn of when it reads it: shake, cuts, repeated frames and more."""

    clip: Clip
    """a video, a folder of pictures or a pattern"""
    fps: float | None = None
    """frames per second of an image sequence"""
    header_only: bool = False
    """read the header alone, at once; else its frames are looked at as `make` would"""
    json: bool = False
    """print as JSON"""


@command
class Hints:
    """Find mask, kind, tilt and scale of a clip only, and write them beside it as a hints file to be corrected."""

    clip: Clip
    """a video, a folder of pictures or a pattern"""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """hints file; by default the clip's name with .hints.yaml, beside it. Hints that stand in it are kept and used"""
    max_size: int | None = None
    """longer side of the working pictures, px (512)"""
    json: bool = False
    """print what was found as JSON"""
    part: tyro.conf.OmitArgPrefixes[PartOptions] = field(default_factory=PartOptions)
    """which part of the clip; it is written as a hint"""


@command
class Mask:
    """Find the fluid only: write masks and overlays, to be corrected and given to make or motion with --mask."""

    clip: Clip
    """a video, a folder of pictures or a pattern"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for mask/####.png and overlay/####.png (numbers from 1001)"""
    camera: Path | None = None
    """camera JSON, as for make: lens distortion is taken out before"""
    roi: str | None = None
    """x,y,width,height in px of the overlay: fluid is only looked for inside"""
    click: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """x,y in px of the overlay: there is fluid here; may be repeated"""
    not_here: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """x,y in px of the overlay: there is none here; may be repeated"""
    max_size: int | None = None
    """longer side of the working pictures, px (512)"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one setting of read, segment or motion, such as --set segment.method=sam2; may be repeated"""
    force: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """run this stage (read, flow, segment, masks) and all after it again; may be repeated"""
    json: bool = False
    """print the outcome as JSON"""
    learned: tyro.conf.OmitArgPrefixes[LearnedOptions] = field(default_factory=LearnedOptions)
    """learned models, which see some things better"""
    part: tyro.conf.OmitArgPrefixes[PartOptions] = field(default_factory=PartOptions)
    """which part of the clip"""


@command
class Motion:
    """Measure how the fluid moves, for every frame: flow, surface and volume velocity as files for other tools."""

    clip: Clip
    """a video, a folder of pictures or a pattern"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for mask/, flow/, velocity/ and more (numbers from 1001), camera.json and motion.json"""
    format: Literal["flo", "exr", "npz"] = "exr"
    """of the flow files; .flo has no place for confidence"""
    raw: bool = False
    """write the flow of single pairs as well, before averaging and completion"""
    max_size: int | None = None
    """longer side of the working pictures, px (512)"""
    config: Path | None = None
    """YAML file with settings"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one setting of read, segment, shape or motion, such as --set motion.wall=log; may be repeated"""
    force: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """run this stage (read, flow, segment, geometry, velocities) and all after it again; may be repeated"""
    json: bool = False
    """print the outcome as JSON"""
    learned: tyro.conf.OmitArgPrefixes[LearnedOptions] = field(default_factory=LearnedOptions)
    """learned models, which see some things better"""
    input: tyro.conf.OmitArgPrefixes[InputOptions] = field(default_factory=InputOptions)
    """files beside the clip; what is not given is estimated"""
    scene: tyro.conf.OmitArgPrefixes[SceneOptions] = field(default_factory=SceneOptions)
    """what you know of the fluid and of the camera"""
    part: tyro.conf.OmitArgPrefixes[PartOptions] = field(default_factory=PartOptions)
    """which part of the clip"""


@command
class Evaluate:
    """Tell how near an asset stays to its own clip, to other footage, or to a case with known truth."""

    asset: Asset
    """asset folder"""
    truth: Path | None = None
    """case folder: video, camera.json, truth.npz, scene.json; by default the asset is held against its own clip"""
    clip: Path | None = None
    """other footage of the same camera to hold it against, such as a part of the clip that was not used"""
    start: Seconds | None = None
    """where in that footage it begins"""
    json: bool = False
    """print as JSON"""


@command
class Validate:
    """Check an asset: schema, hashes, every frame, scene.yaml, USD, preview; say what to do."""

    asset: Asset
    """asset folder"""
    json: bool = False
    """print as JSON"""


@command
class Demo:
    """Make an asset from the clip that comes with the package."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("demo.fluid")
    """asset folder to write"""


@command
class Generators:
    """List third-party generators and what is there of them, or explain one: licence, hardware, installation."""

    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")] = None
    """generator to explain; by default all are listed"""
    python: Path | None = None
    """Python of the environment to look at; by default this one"""
    code: Path | None = None
    """folder of the generator's own code, where that is a checkout"""
    json: bool = False
    """print as JSON"""


@command
class Doctor:
    """Tell what is installed and what this machine can do."""

    json: bool = False
    """print as JSON"""
    compile: bool = False
    """compile everything now (a minute or so), so that the first job of an installation is as fast as the next"""


def options_of(command: type) -> dict[str, str]:
    """The options of a command by name, those of its groups among them, with their types as they are written."""
    found: dict[str, str] = {}
    for f in fields(command):
        group = f.default_factory if is_dataclass(f.default_factory) else None
        found |= {f.name.rstrip("_"): str(f.type)} if group is None else options_of(group)
    return found
