"""Where the frames of a USD export go: into one file, sample after sample, or into a file each as value clips.

Both write what a reader without time sees (the default values) into the payload: the first frame that holds anything.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Protocol

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from fluidlift.io.atomic import atomic_path
from fluidlift.io.frames import FluidFrame
from fluidlift.io.usd_prims import NO_MESH, FluidPrims

CLIPS = "frames"
"""folder of the clips, beside the file"""

_SAVE_AFTER = 128 * 2**20
"""bytes of samples; saved samples are read from the disk again only when needed, so memory stays bounded"""


class UsdFrames(Protocol):
    """What both layouts can do."""

    def add(self, frame: FluidFrame, code: int) -> None:
        """Write one frame, in the axes and units of the file."""
        ...

    def finish(self) -> list[Path]:
        """Files beside the payload."""
        ...


class _Defaults:
    """The payload's default values: the first frame with splats, the first with white water, and the first surface."""

    def __init__(self, stage: Usd.Stage, half: bool) -> None:
        self.stage, self.half = stage, half
        self.prims: FluidPrims | None = None
        self.splats_shown = self.surface_shown = self.white_shown = False

    def see(self, frame: FluidFrame) -> FluidPrims:
        """The payload's prims, after a look at a frame."""
        now, g = Usd.TimeCode.Default(), frame.gaussians
        fresh = self.prims is None
        if self.prims is None:
            self.prims = FluidPrims(self.stage, g.sh.shape[1], self.half)
        if fresh or (not self.splats_shown and len(g)):
            self.prims.set(frame._replace(surface=None), now)
            self.splats_shown = len(g) > 0
        if frame.kinds is not None and not self.white_shown:
            white = np.asarray(frame.kinds) >= 0
            self.prims.set_whitewater(frame.part(white), now)
            self.white_shown = bool(white.any())
        if frame.surface is not None and not self.surface_shown:
            self.prims.set_surface(frame.surface, frame.surface_velocities, now)
            self.surface_shown = len(frame.surface.faces) > 0
        return self.prims


class SampledFrames:
    """Every frame a time sample in the payload."""

    def __init__(self, stage: Usd.Stage, half: bool) -> None:
        self._stage, self._defaults = stage, _Defaults(stage, half)
        self._unsaved, self._first = 0, -1

    def add(self, frame: FluidFrame, code: int) -> None:
        """Write one frame."""
        self._first = code if self._first < 0 else self._first
        known = self._defaults.prims is not None and self._defaults.prims.surface is not None
        prims = self._defaults.see(frame)
        if frame.surface is not None and not known:
            for before in range(self._first, code):  # until now there was none
                prims.set_surface(NO_MESH, np.zeros((0, 3)), Usd.TimeCode(before))
        self._unsaved += prims.set(frame, Usd.TimeCode(code))
        if frame.surface is None and known:
            prims.set_surface(NO_MESH, np.zeros((0, 3)), Usd.TimeCode(code))
        if self._unsaved > _SAVE_AFTER:
            self._stage.GetRootLayer().Save()
            self._unsaved = 0

    def finish(self) -> list[Path]:
        """No further files."""
        return []


class ClippedFrames:
    """Every frame a file of its own; a farm can take one, and memory does not grow with their number.

    What is written where (ecosystem: UsdUtils.StitchClips does the same from finished files): the clips' metadata stand
    in the layer above the payload, so that samples win over the payload's default values; the manifest lists the
    attributes, and gives what a clip without them has: nothing.
    """

    def __init__(self, path: Path, stage: Usd.Stage, half: bool, fps: float) -> None:
        """`path` of the interface layer, `stage` of the payload."""
        self._folder, self._stem, self._fps, self._half = path.parent / CLIPS, path.stem, fps, half
        self._stage, self._defaults, self._files = stage, _Defaults(stage, half), []

    def add(self, frame: FluidFrame, code: int) -> None:
        """Write one frame."""
        self._defaults.see(frame)
        path = self._folder / f"{self._stem}.{code:04d}.usdc"
        with atomic_path(path) as temporary:
            clip = _new_stage(temporary, self._fps, (code, code))
            copied = UsdGeom.GetStageUpAxis(self._stage), UsdGeom.GetStageMetersPerUnit(self._stage)
            UsdGeom.SetStageUpAxis(clip, copied[0])
            UsdGeom.SetStageMetersPerUnit(clip, copied[1])
            FluidPrims(clip, frame.gaussians.sh.shape[1], self._half).set(frame, Usd.TimeCode(code))
            clip.GetRootLayer().Save()
        reload(path)
        self._files.append(path)

    def finish(self) -> list[Path]:
        """The manifest, without clips of an earlier run that this one has not."""
        path = self._folder / f"{self._stem}.manifest.usda"
        with atomic_path(path) as temporary:
            manifest = _new_stage(temporary, self._fps, None)
            for name in ("Splats", "Points", "Whitewater", "Surface"):
                prim = self._stage.GetPrimAtPath(f"/Fluid/{name}")
                if prim:
                    _declare(manifest, prim)
            manifest.GetRootLayer().Save()
        reload(path)
        ours = re.compile(re.escape(self._stem) + r"\.\d{4,}\.usdc")
        for old in self._folder.iterdir():
            if ours.fullmatch(old.name) and old not in self._files and not old.is_symlink():
                old.unlink()
        return [path, *self._files]


def refer_to_clips(root: Usd.Prim, path: Path, times: tuple[int, int]) -> None:
    """The metadata of the clips of `path` on the root prim of its interface layer."""
    api = Usd.ClipsAPI(root)
    api.SetClipTemplateAssetPath(f"./{CLIPS}/{path.stem}.####.usdc")
    api.SetClipTemplateStartTime(times[0])
    api.SetClipTemplateEndTime(times[1])
    api.SetClipTemplateStride(1)
    api.SetClipPrimPath("/Fluid")
    api.SetClipManifestAssetPath(Sdf.AssetPath(f"./{CLIPS}/{path.stem}.manifest.usda"))


def reload(path: Path) -> None:
    """If this process has the replaced file open, show it the new content."""
    layer = Sdf.Layer.Find(str(path))
    if layer is not None:
        layer.Reload(force=True)


def _new_stage(path: Path, fps: float, times: tuple[int, int] | None) -> Usd.Stage:
    path.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Fluid").GetPrim())
    stage.SetTimeCodesPerSecond(fps)
    if times is not None:
        stage.SetStartTimeCode(times[0])
        stage.SetEndTimeCode(times[1])
    return stage


def _declare(manifest: Usd.Stage, prim: Usd.Prim) -> None:
    """All of a prim's attributes that a clip may hold, empty."""
    declared = manifest.OverridePrim(prim.GetPath())
    for attribute in prim.GetAuthoredAttributes():
        kind = attribute.GetTypeName()
        if attribute.GetVariability() != Sdf.VariabilityVarying or not kind.isArray:
            continue
        nothing = Vt.Vec3fArray(2) if attribute.GetName() == "extent" else kind.defaultValue
        declared.CreateAttribute(attribute.GetName(), kind, custom=False).Set(nothing)
