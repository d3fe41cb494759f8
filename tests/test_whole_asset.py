"""A small clip becomes an asset in which nothing is missing: the one whole asset of `make test`."""

import pytest

from fluidlift.cli import DONE, WITH_WARNINGS
from fluidlift.io.asset_folder import read_manifest
from fluidlift.validate import validate_asset

FRAMES = 10


def test_the_exit_code_says_whether_there_were_warnings(made):
    warnings = read_manifest(made.folder)["warnings"]
    assert made.code == (WITH_WARNINGS if warnings else DONE), warnings


@pytest.mark.parametrize(
    "name",
    [
        "manifest.json", "parameters.json", "scene.yaml", "rest/gaussians.ply", "rest/terrain.glb", "rest/velocity.vdb",
        "rest/camera.json", "frames/splats/1001.flsp", f"frames/splats/{1000 + FRAMES}.flsp", "asset.usda",
        "preview.mp4", "report.html", "mask_overlay.png",
    ],
)  # fmt: skip
def test_every_part_of_the_asset_is_there(made, name):
    assert (made.folder / name).stat().st_size > 0


def test_no_temporary_files_are_left(made):
    assert not [p for p in made.folder.rglob("*") if ".part" in p.name]


def test_all_checks_of_the_asset_pass(made):
    findings = validate_asset(made.folder)
    assert len(findings) > 5
    assert not [f for f in findings if not f.passed]
