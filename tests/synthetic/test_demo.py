"""The clip that comes with the package is whole, small, and true."""

import json

import numpy as np
import pytest

from fluidlift.evaluate import read_case
from fluidlift.io.video import read_clip
from fluidlift.synthetic.demo import FILES, data_file, demo_camera, demo_clip, unpack_demo_case
from fluidlift.synthetic.make_demo import make_demo


def test_the_demo_fits_into_the_package():
    sizes = [data_file(name).stat().st_size for name in (*FILES.values(), "demo_camera.json")]
    assert sum(sizes) < 1_000_000


def test_the_demo_clip_belongs_to_its_camera_and_its_truth(tmp_path):
    clip, camera = read_clip(demo_clip()), demo_camera()
    assert clip.size == camera.size and clip.interval == pytest.approx(0.04)
    case = read_case(unpack_demo_case(tmp_path / "case"))
    assert len(case) == len(clip)
    np.testing.assert_allclose(case.camera.position, camera.position)
    # the truth's raster is coarser, the view the same
    assert case.camera.size[0] / camera.size[0] == pytest.approx(case.camera.focal[0] / camera.focal[0])
    assert 0.3 < case.mask.mean() < 0.7


def test_the_demo_truth_obeys_its_own_figures(tmp_path):
    case = read_case(unpack_demo_case(tmp_path / "case"))
    speed = np.linalg.norm(case.velocity[0].astype(float)[case.occupied(0)], axis=-1).mean()
    # a stream that runs on at the speed of its inlet, give or take the rocks and the slope
    assert speed == pytest.approx(case.scene["inflow"]["velocity_m_s"][0], rel=0.3)
    volumes = [case.occupied(k).sum() for k in range(len(case.key_frames))]
    # nearly steady: over the 1.6 s of the clip the volume stays within a tenth
    assert max(volumes) / min(volumes) < 1.1


def test_the_demo_can_be_made_anew(tmp_path, capsys):
    files = make_demo(tmp_path / "out", size=(32, 24), frames=2, cells=16, settle=0.0)
    assert {f.name for f in files} == {*FILES.values(), "demo_camera.json"}
    assert json.loads((tmp_path / "out" / "demo_scene.json").read_text())["case"] == "stream"
    assert "frame 2 of 2" in capsys.readouterr().err
