"""The preview of a finished asset."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.config.of_asset import settings_of
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.pipeline.settings import ShowSettings, taken
from fluidlift.pipeline.stages import show
from fluidlift.present.front_view import open_end
from fluidlift.scene.build import SimulationRequest, scene_of
from fluidlift.types.gaussians import concatenate


def test_from_the_side_a_stream_ends_where_its_section_is(made, monkeypatch):
    asset = load_asset(made.folder)
    config = settings_of(read_manifest(made.folder), (), {}, sections=("simulate", "show"), work="a picture")
    request = SimulationRequest(fps=1.0 / asset.interval)
    scene = scene_of(asset, made.folder, request, config, footage=None, start=0)
    end, settings = open_end(scene), taken(ShowSettings, config.show)
    assert end is not None
    fluid, *_ = next(iter(show.splat_frames(made.folder, 1)))
    stream = fluid.select(end.before(fluid.means))
    # drops high above what is behind the section
    drops = stream.select(np.arange(0, len(stream), 10))
    over = end.at + 2 * end.spacing - drops.means @ end.along
    drops = replace(drops, means=drops.means + over[:, None] * end.along + [0, 0, 4 * end.spacing])

    def panels(gaussians):
        frame = gaussians, np.arange(len(gaussians)), np.zeros_like(gaussians.means)
        monkeypatch.setattr(show, "splat_frames", lambda folder, count: iter([frame]))
        poses, measured = np.zeros((1, len(scene.obstacles), 7)), {"frames": [], "mask": [], "flow": []}
        found = next(show._panels(scene, None, made.folder, settings, poses, measured, lambda *_: None, None))
        return np.split(found, 2, axis=1)

    (input_view, side), (input_ragged, side_ragged) = panels(stream), panels(concatenate([stream, drops]))
    np.testing.assert_array_equal(side_ragged, side)
    assert (input_ragged != input_view).any()  # where it is compared with the clip, nothing is left out


def test_frames_read_ahead_are_the_same_one_by_one():
    begun = []

    def frames(broken: int | None = None):
        for k in range(5):
            if k == broken:
                raise OSError("damaged")
            begun.append(k)
            yield k, np.zeros(k)

    ahead = show._read_ahead(frames())
    for k in range(5):
        number, empty = next(ahead)
        assert (number, len(empty)) == (k, k)
        assert len(begun) <= k + 2  # one waits, and no more
    assert list(ahead) == []
    found = []
    with pytest.raises(OSError, match="damaged"):
        found.extend(number for number, _ in show._read_ahead(frames(broken=3)))
    ahead = show._read_ahead(frames())
    next(ahead)
    ahead.close()  # nobody waits for a film that is no longer wanted
