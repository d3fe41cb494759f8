"""Dam breaks: a prism that stands on level ground until it is let go (`shape.standing`)."""

from __future__ import annotations

from fluidlift.errors import InputRejected, require
from fluidlift.shape.standing import standing_front


class _Dam:
    def front_surface(self, seen):
        require(seen.standing is not None, "no standing body", "the one that `standing.find_standing` finds")
        return standing_front(seen.camera, seen.standing)

    def depth_surface(self, scene, seen, slopes, usual):
        raise InputRejected("a depth of a dam", "the outline of the body as it stands", "leave the depth out")

    def mainstream(self, bulk):
        return bulk


BUILDER = _Dam()
