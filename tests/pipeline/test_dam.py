"""A dam that breaks, from the clip to frames that can be played: it stands, falls, and stays in its basin."""

import numpy as np
import pytest

from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.force_file import read_filmed
from fluidlift.look.surface_skin import without_skin
from fluidlift.pipeline import card_of
from fluidlift.scene.splat_files import frame_files, read_frame
from fluidlift.types import CellType
from fluidlift.validate import validate_asset

FRAMES = 20


@pytest.fixture(scope="module")
def dam(catalogue_asset):
    job = catalogue_asset("dam")
    assert job.code in (DONE, WITH_WARNINGS)
    return job


@pytest.fixture(scope="module")
def case(dam):
    return dam.clip.parent


@pytest.fixture(scope="module")
def folder(dam):
    return dam.folder


def test_it_is_taken_for_what_it_is(folder):
    asset, manifest = load_asset(folder), read_manifest(folder)
    assert asset.kind == manifest["kind"] == "dam"
    own = [text for text in manifest["warnings"] if text != card_of(manifest).warning()]  # of the clip's likeness
    assert not any("level" in text or "size" in text for text in own)  # the camera file says both


def test_the_column_stands_where_it_stood(folder):
    # 0.5 m long, 0.9 wide and 0.6 high on ground at 0.05; a pixel is 1.5 cm there. Its far side is seen over its top:
    # three pixels of height move it by 20 cm
    points = load_asset(folder).rest.means
    np.testing.assert_allclose(np.percentile(points, 2, axis=0), [-1.0, -0.45, 0.05], atol=0.1)
    missed = np.abs(np.percentile(points, 98, axis=0) - [-0.5, 0.45, 0.65])
    assert (missed < [0.1, 0.22, 0.1]).all(), missed


def test_nothing_flows_in_or_out_and_it_starts_at_rest(folder):
    asset = load_asset(folder)
    assert set(np.unique(asset.cell_types)) <= {CellType.EMPTY, CellType.FLUID, CellType.SOLID}
    assert not any(part.any() for part in asset.velocity.components)
    assert asset.parameters.inflow_velocity == (0.0, 0.0, 0.0)
    assert asset.parameters.gravity == pytest.approx((0.0, 0.0, -9.81))
    assert not any(e.fitted for e in asset.estimates.values())


def test_it_falls_and_spreads_and_keeps_its_body(folder):
    frames = frame_files(folder)
    cell = load_asset(folder).grid.spacing
    shown = (read_frame(path).gaussians for path in (frames[0], frames[-1]))
    first, last = (without_skin(gaussians, cell).means for gaussians in shown)
    assert len(frames) == 8 and len(last) == pytest.approx(len(first), rel=0.01)
    assert np.percentile(last[:, 2], 95) < np.percentile(first[:, 2], 95) - 0.1
    assert np.percentile(last[:, 0], 98) > np.percentile(first[:, 0], 98) + 0.3
    # g t^2 / 2 after 7 / 25 s: nothing falls further, nothing is thrown out of the box
    assert 0.0 < first[:, 2].mean() - last[:, 2].mean() < 0.5 * 9.81 * (7 / 25) ** 2
    asset = load_asset(folder)
    assert asset.grid.contains(last).mean() > 0.999
    assert all(finding.passed for finding in validate_asset(folder))


def test_what_collapses_keeps_all_its_fluid_wherever_its_film_shows_none(folder):
    assert read_filmed(folder).dry is None


def test_a_fit_of_its_parameters_is_refused_and_says_why(folder, case, capsys):
    assert main(["fit", str(folder), "--free", "kinematic_viscosity"]) == REJECTED
    assert "before it moves" in capsys.readouterr().err
