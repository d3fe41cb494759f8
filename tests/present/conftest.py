"""The fixtures of `small_scene`."""

from small_scene import camera, channel, finished  # noqa: F401
