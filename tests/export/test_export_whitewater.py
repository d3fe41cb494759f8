"""White water in the files for other tools: places, velocities and kinds come back, and without any nothing changes."""

from __future__ import annotations

import json
import shutil
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from read_vdb import read_vdb

from fluidlift.cli import DONE, WITH_WARNINGS, main
from fluidlift.export.whitewater import KINDS, WhitewaterFiles, has_whitewater, spread, whitewater_grids, with_kinds
from fluidlift.io.asset_folder import load_asset, read_manifest, update_manifest
from fluidlift.io.export_usd import UsdSettings, write_usd
from fluidlift.io.frames import FluidFrame
from fluidlift.io.packed_splats import write_packed
from fluidlift.io.ply import read_splats
from fluidlift.io.ply_records import read_elements
from fluidlift.io.spz import read_spz
from fluidlift.io.validate_usd import validate_usd
from fluidlift.look.whitewater_splats import kinds_of, whitewater_splats
from fluidlift.scene.splat_files import frame_file, read_frame
from fluidlift.types import Gaussians, Grid, Similarity3, concatenate

CELL, COLOR = 0.05, (0.9, 0.92, 0.95)
FIRST_ID = 2**29 + 1


def white_frame(n: int, low, high, cell: float, seed: int = 3) -> FluidFrame:
    """White water of all kinds in a box."""
    rng = np.random.default_rng(seed)
    kinds = (np.arange(n) % 3).astype(np.uint8)
    splats = whitewater_splats(rng.uniform(low, high, (n, 3)), kinds, rng.uniform(0.1, 2, n), COLOR, cell)
    velocities = rng.normal(size=(n, 3)).astype(np.float32)
    return FluidFrame(splats, FIRST_ID + 2 * np.arange(n), velocities, kinds=kinds.astype(np.int64))


def joined(body: FluidFrame, white: FluidFrame) -> FluidFrame:
    """Both in one frame, as a simulation writes it."""
    return FluidFrame(
        concatenate([body.gaussians, white.gaussians]), np.concatenate([body.ids, white.ids]),
        np.concatenate([body.velocities, white.velocities]).astype(np.float32),
    )  # fmt: skip


def body(n: int = 40) -> FluidFrame:
    rng = np.random.default_rng(1)
    splats = Gaussians.isotropic(rng.uniform(0, 1, (n, 3)), 0.4 * CELL, np.full((n, 3), 0.4), 0.9)
    return FluidFrame(splats, 2 * np.arange(n), rng.normal(size=(n, 3)).astype(np.float32))


def frames(counts=(0, 30, 45)) -> list[FluidFrame]:
    """A body at rest, and white water that comes."""
    return [with_kinds(joined(body(), white_frame(n, 0, 1, CELL)), CELL) for n in counts]


@pytest.fixture(scope="module")
def foaming(made, tmp_path_factory):
    """An asset of three frames, with white water from the second on."""
    folder = shutil.copytree(made.folder, tmp_path_factory.mktemp("white") / "foam.fluid")
    cell, told = load_asset(folder).grid.spacing, read_manifest(folder)["simulation"]
    for k, n in ((1002, 300), (1003, 330)):
        frame = read_frame(frame_file(folder, k))
        low, high = np.percentile(frame.gaussians.means, [20, 80], axis=0)
        both = joined(frame, white_frame(n, low, high, cell))
        write_packed(frame_file(folder, k), both.gaussians, ids=both.ids, velocities=both.velocities)
    update_manifest(folder, simulation=told | {"parts": dict(told.get("parts", {})) | {"white water": "x"}})
    return SimpleNamespace(folder=folder, cell=cell)


def exported(foaming, out, *options):
    command = ["export", str(foaming.folder), "-o", str(out), "--frames", "1001-1003", *options]
    assert main(command) in (DONE, WITH_WARNINGS)
    return out


def own(foaming, number: int) -> FluidFrame:
    """The white water that the frame's file holds."""
    frame = with_kinds(read_frame(frame_file(foaming.folder, number)), foaming.cell)
    return frame.part(frame.kinds >= 0)


@pytest.mark.parametrize("layout", ["file", "clips"])
@pytest.mark.parametrize("axis", ["z", "y"])
def test_usd_has_a_prim_of_its_own_with_kinds_velocities_and_ids(tmp_path, layout, axis):
    path, told = tmp_path / "a.usda", frames()
    write_usd(path, frames=told, interval=0.04, settings=UsdSettings(up_axis=axis, meters_per_unit=0.1, layout=layout))
    assert validate_usd(path) == []
    stage = Usd.Stage.Open(str(path))
    points, turn = UsdGeom.Points(stage.GetPrimAtPath("/Fluid/Whitewater")), Similarity3(10.0)
    for code, frame in enumerate(told, 1001):
        white = frame.part(frame.kinds >= 0)
        back = (np.array(a.Get(code)).reshape(-1, 3) for a in (points.GetPointsAttr(), points.GetVelocitiesAttr()))
        for values, wanted in zip(back, (turn.points(white.gaussians.means), turn.vectors(white.velocities))):
            x, y, z = np.asarray(wanted).reshape(-1, 3).T
            np.testing.assert_allclose(values, np.stack([x, y, z] if axis == "z" else [x, z, -y], 1), rtol=1e-5)
        kind = UsdGeom.PrimvarsAPI(points).GetPrimvar("kind")
        np.testing.assert_array_equal(np.array(kind.Get(code), int), white.kinds)
        assert kind.GetInterpolation() == "vertex"
        np.testing.assert_array_equal(np.array(points.GetIdsAttr().Get(code), int), white.ids)
        np.testing.assert_allclose(np.array(points.GetDisplayOpacityPrimvar().Get(code)), white.gaussians.opacities)
        widths = np.array(points.GetWidthsAttr().Get(code))
        np.testing.assert_allclose(widths, 20 * np.cbrt(white.gaussians.scales.prod(axis=1)), rtol=1e-4)
        others = UsdGeom.Points(stage.GetPrimAtPath("/Fluid/Points")).GetIdsAttr().Get(code)
        np.testing.assert_array_equal(np.array(others), frame.ids[frame.kinds < 0])


def test_white_water_is_not_drawn_twice_where_splats_are_shown(tmp_path):
    write_usd(tmp_path / "a.usda", frames=frames(), interval=0.04)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    variants = stage.GetDefaultPrim().GetVariantSet("representation")
    for name, seen in (("splats", False), ("points", True), ("surface", True)):
        variants.SetVariantSelection(name)
        prim = UsdGeom.Imageable(stage.GetPrimAtPath("/Fluid/Whitewater"))
        assert (prim.ComputeVisibility() == "inherited") is seen, name


def test_usd_refuses_kinds_in_some_frames_only(tmp_path):
    told = frames()
    with pytest.raises(ValueError, match="in all or in none"):
        write_usd(tmp_path / "a.usda", frames=[told[0]._replace(kinds=None), *told[1:]], interval=0.04)
    with pytest.raises(ValueError, match="kinds"):
        write_usd(tmp_path / "a.usda", frames=[told[1]._replace(kinds=np.zeros(3))], interval=0.04)


@pytest.mark.parametrize(("name", "value"), [("kind", [0, 1, 7]), ("kind", [0, 1]), ("displayOpacity", [0.1, 0.2, 3])])
def test_the_validator_sees_kinds_and_opacities_that_are_none(tmp_path, name, value):
    write_usd(tmp_path / "a.usda", frames=frames((3,)), interval=0.04)
    layer = tmp_path / "a.usdc"
    stage = Usd.Stage.Open(str(layer))
    UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Fluid/Whitewater")).GetPrimvar(name).Set(value, 1001)
    stage.GetRootLayer().Save()
    assert any(name.replace("displayOpacity", "opacities") in f for f in validate_usd(layer))


def test_points_stand_beside_the_meshes_in_every_frame(foaming, tmp_path):
    out = exported(foaming, tmp_path / "out", "--up-axis", "y", "--meters-per-unit", "0.01")
    assert sorted(p.name for p in (out / "whitewater").iterdir()) == ["1001.ply", "1002.ply", "1003.ply"]
    for number, count in ((1001, 0), (1002, 300), (1003, 330)):
        elements, comments = read_elements(out / "whitewater" / f"{number}.ply")
        table, white = elements["vertex"], own(foaming, number)
        assert len(table) == count and comments == ["y up, one unit is 0.01 m"]
        np.testing.assert_array_equal(table["kind"], white.kinds)
        np.testing.assert_array_equal(table["id"], white.ids)
        for stem, values in (("", white.gaussians.means), ("v", white.velocities)):
            x, y, z = 100 * values.T
            back = np.stack([table[stem + a] for a in "xyz"], axis=1)
            np.testing.assert_allclose(back, np.stack([x, z, -y], axis=1), rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(table["opacity"], white.gaussians.opacities)
        if count:
            foam = table["radius"][table["kind"] == 1]
            np.testing.assert_allclose(foam, 100 * foaming.cell * 0.16 * np.cbrt(0.72), rtol=2e-3)
            np.testing.assert_allclose(table["red"], 255 * COLOR[0], atol=1.5)


def test_points_of_an_earlier_run_do_not_stay(tmp_path):
    files = WhitewaterFiles(tmp_path, Similarity3(), "metres, z up")
    files.write(0, frames((5,))[0])
    (tmp_path / "whitewater" / "mine.txt").touch()
    WhitewaterFiles(tmp_path, Similarity3(), "metres, z up").write(0, body())
    assert [p.name for p in (tmp_path / "whitewater").iterdir()] == ["mine.txt"]
    (tmp_path / "whitewater" / "mine.txt").unlink()
    WhitewaterFiles(tmp_path, Similarity3(), "metres, z up")
    assert not (tmp_path / "whitewater").exists()


def test_volumes_hold_the_light_that_splats_take(foaming, tmp_path):
    out = exported(foaming, tmp_path / "out", "--to", "vdb")
    white, h = own(foaming, 1002), foaming.cell
    for number, empty in ((1001, True), (1002, False)):
        grids = {g["name"]: g for g in read_vdb(out / f"{number}.vdb")}
        assert set(grids) == {"vel", "density", "surface", *KINDS}
        for kind, name in enumerate(KINDS):
            voxels = grids[name]["voxels"]
            assert bool(voxels) is not empty
            if empty:
                continue
            g = white.gaussians.select(white.kinds == kind)
            areas = 2 * np.pi * np.cbrt(g.scales.prod(axis=1)) ** 2 * g.opacities
            values, at = np.array([float(v[0]) for v in voxels.values()]), np.array(list(voxels))
            assert values.sum() * h**3 == pytest.approx(areas.sum(), rel=1e-4)
            middle = np.array(grids[name]["maps"][0]) + h * (values[:, None] * at).sum(axis=0) / values.sum()
            np.testing.assert_allclose(middle, (areas[:, None] * g.means).sum(axis=0) / areas.sum(), atol=1e-3 * h)


def test_voxels_of_white_water_lie_on_the_cells():
    cells = Grid((4, 4, 4), CELL, (0.1, 0.2, 0.3))
    place = cells.low + CELL * np.array([2.5, 0.5, 3.5])
    splats = whitewater_splats(place[None], np.array([1], np.uint8), np.array([9.0]), COLOR, CELL)
    frame = FluidFrame(splats, np.array([1]), np.zeros((1, 3)), kinds=np.array([1]))
    spray, foam, bubbles = whitewater_grids(frame, cells)
    assert not spray.values.any() and not bubbles.values.any()
    found = np.array(foam.origin) + CELL * (np.argwhere(foam.values > 1e-3 * foam.values.max()) + 0.5)
    np.testing.assert_allclose(found, place[None], atol=1e-6)
    assert whitewater_grids(frame._replace(kinds=None), cells) == []


def test_amounts_are_shared_among_the_cells_around():
    values, first = spread(np.array([[0.5, 1.0, -2.25]]), np.array([8.0]))
    np.testing.assert_array_equal(first, [0, 0, -3])
    np.testing.assert_allclose(values[0], [[3.0, 1.0], [3.0, 1.0]])
    assert values.sum() == pytest.approx(8.0)


def test_splat_files_tell_the_kind_in_every_frame(foaming, tmp_path):
    out = exported(foaming, tmp_path / "out", "--to", "splats")
    for number in (1001, 1002):
        back = read_splats(out / f"{number}.ply")
        wanted = with_kinds(read_frame(frame_file(foaming.folder, number)), foaming.cell).kinds
        np.testing.assert_array_equal(back.extras["kind"], wanted)


def test_the_small_formats_hold_white_water_among_their_splats(foaming, tmp_path):
    out = exported(foaming, tmp_path / "out", "--to", "spz")
    frame = read_frame(frame_file(foaming.folder, 1002))
    back, white = read_spz(out / "1002.spz"), kinds_of(frame.gaussians, foaming.cell) >= 0
    np.testing.assert_allclose(np.sort(back.means[:, 0]), np.sort(frame.gaussians.means[:, 0]), atol=1e-3)
    assert len(back) == len(white) and white.sum() == 300
    page = exported(foaming, tmp_path / "page", "--to", "html") / "page.html"
    assert page.stat().st_size > 0


def test_gltf_has_points_beside_the_surface(foaming, tmp_path):
    out = exported(foaming, tmp_path / "out", "--to", "gltf")
    data = (out / "surface.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    told = json.loads(data[20 : 20 + length])
    node = next(n for n in told["nodes"] if n["name"] == "white water")
    (points,) = told["meshes"][node["mesh"]]["primitives"]
    assert points["mode"] == 0

    def numbers(name: str) -> np.ndarray:
        accessor = told["accessors"][points["attributes"][name]]
        start = 20 + length + 8 + told["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        return np.frombuffer(data, "<f4", width * accessor["count"], start).reshape(-1, width)

    white = own(foaming, 1002)
    np.testing.assert_array_equal(numbers("_KIND")[:, 0], white.kinds)
    for name, values in (("POSITION", white.gaussians.means), ("_VELOCITY", white.velocities)):
        x, y, z = values.T
        np.testing.assert_allclose(numbers(name), np.stack([x, z, -y], axis=1), atol=1e-6)


def test_a_fluid_without_white_water_is_written_as_before(made, tmp_path):
    """The same frames, told in tuples that know of no kinds."""
    assert not has_whitewater(read_manifest(made.folder)) and not has_whitewater({})
    out = exported(made, tmp_path / "mesh")
    assert not (out / "whitewater").exists()
    names = {g["name"] for g in read_vdb(exported(made, tmp_path / "vdb", "--to", "vdb") / "1001.vdb")}
    assert names == {"vel", "density", "surface"}
    assert "kind" not in read_splats(exported(made, tmp_path / "splats", "--to", "splats") / "1002.ply").extras
    stage = Usd.Stage.Open(str(exported(made, tmp_path / "usd", "--to", "usd") / "fluid.usda"))
    assert not stage.GetPrimAtPath("/Fluid/Whitewater")
