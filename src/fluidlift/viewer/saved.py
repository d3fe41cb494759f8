"""The frames on disk, and who else writes them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import FluidliftError
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.asset_lock import writer_of
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.stage_cache import owner_of
from fluidlift.pipeline.recall import simulated_poses
from fluidlift.pipeline.splat_files import frame_file


class SavedFrames:
    """What an asset's folder holds, and whether another process is about to change it.

    Raises:
        InputRejected: no asset, or a damaged one.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.asset = load_asset(folder)
        self.manifest: dict[str, Any] = {}
        self.count, self.interval, self.spacing = 0, self.asset.interval, self.asset.grid.spacing
        """frames, s between them, m of the cells that they were simulated on"""
        self.foreign = False
        """another process is writing"""
        self._poses: np.ndarray | None = None
        self._stamp: tuple[int, str | None] = (0, None)
        self._scene = (0, 0)
        self.reload()
        self.look(ours=False)
        self.scene_changed()

    def reload(self) -> None:
        """Read again what is there."""
        try:
            self.manifest = read_manifest(self.folder)
        except (FluidliftError, OSError):
            return  # in the middle of being written: what was there before stays
        played = self.manifest.get("simulation", {})
        self.count = int(played.get("frames", 0))
        self.interval = float(played.get("frame_interval", self.asset.interval))
        self.spacing = float(played.get("grid", {}).get("spacing", self.asset.grid.spacing))
        self._stamp = self._now()
        self._poses = simulated_poses(self.folder)

    def _now(self) -> tuple[int, str | None]:
        try:
            written = (self.folder / "manifest.json").stat().st_mtime_ns
        except OSError:
            written = 0
        return written, owner_of(self.folder, "simulate")

    def look(self, *, ours: bool) -> bool:
        """Look at the folder again; whether what is shown must be read again.

        Args:
            ours: we are the ones who write.
        """
        now = self._now()
        holder = None if ours else writer_of(self.folder)
        self.foreign = holder is not None and holder.pid != os.getpid()
        if ours or self.foreign or now == self._stamp:
            return False
        self.reload()
        return True

    def scene_changed(self) -> bool:
        """Whether scene.yaml is another one than at the last look."""
        try:
            found = (self.folder / "scene.yaml").stat()
            stamp = (found.st_mtime_ns, found.st_size)
        except OSError:
            stamp = (0, 0)
        before, self._scene = self._scene, stamp
        return before != stamp

    def poses(self, index: int) -> np.ndarray | None:
        """[b,7] of the obstacles at a frame, from 0; None where they are not known."""
        if self._poses is None or index >= len(self._poses):
            return None
        return self._poses[index]

    def missing(self) -> list[int]:
        """Numbers (from 1001) of frames that should be there and are not."""
        return [FIRST_FRAME + k for k in range(self.count) if not frame_file(self.folder, FIRST_FRAME + k).is_file()]
