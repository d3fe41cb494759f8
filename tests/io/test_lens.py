"""A focal length in the metadata gives the field of view."""

import av
import numpy as np
import pytest

from fluidlift.io.lens import lens_field_of_view


def clip_with(path, metadata):
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata.update(metadata)
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(3):
            for packet in stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), "rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


@pytest.mark.parametrize(("focal", "degrees"), [("18", 90.0), ("36.0 mm", 53.130)])
def test_a_35_mm_equivalent_focal_length_is_read(tmp_path, focal, degrees):
    key = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
    # 2 atan(36 / 2f): 90 degrees at 18 mm
    assert lens_field_of_view(clip_with(tmp_path / "a.mp4", {key: focal})) == pytest.approx(degrees, abs=0.01)


@pytest.mark.parametrize("metadata", [{}, {"com.apple.quicktime.camera.focal_length.35mm_equivalent": "0"}])
def test_nothing_useful_says_nothing(tmp_path, metadata):
    assert lens_field_of_view(clip_with(tmp_path / "b.mp4", metadata)) is None
