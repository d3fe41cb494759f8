"""Streams: a surface close to a level plane, whose tilt, slope and chutes show in its motion."""

from __future__ import annotations

from fluidlift.shape import depth_surface, surface


class _Stream:
    def front_surface(self, seen):
        marked = None
        if seen.ledges is not None:
            marked = surface.chutes_on_level(seen.camera, seen.mask, seen.motion, seen.trust, seen.ledges)
        return marked or surface.stream_surface(
            seen.camera, seen.mask, seen.motion, seen.trust, seen.interval, camera_height=seen.camera_height,
            tilt_known=seen.tilt_known, prior=seen.slopes,
        )  # fmt: skip

    def depth_surface(self, scene, seen, slopes, usual):
        return depth_surface.stream_surface(
            scene, seen.camera, seen.mask, seen.motion, seen.trust, slopes=slopes, usual=usual
        )

    def mainstream(self, bulk):
        return bulk


BUILDER = _Stream()
