"""Splats, points and meshes survive a round trip through PLY, and bad files are refused before memory is taken."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.ply import AXES, read_gaussians, read_mesh, read_splats, write_gaussians, write_mesh, write_points
from fluidlift.numerics import harmonics
from fluidlift.types import Gaussians


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("axes", list(AXES))
def test_splats_come_back(tmp_path, gaussians, coefficients, axes):
    g = gaussians(50, coefficients)
    velocities = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    path = write_gaussians(tmp_path / "a.ply", g, ids=np.arange(50) * 3, velocities=velocities, axes=axes)
    back = read_splats(path)
    for name in ("means", "scales", "opacities", "sh"):  # float32 through log, exp and a rotation
        np.testing.assert_allclose(getattr(back.gaussians, name), getattr(g, name), rtol=2e-5, atol=2e-6)
    np.testing.assert_allclose(back.gaussians.covariances(), g.covariances(), atol=1e-8)
    np.testing.assert_array_equal(back.extras["id"], np.arange(50) * 3)
    np.testing.assert_allclose(np.stack([back.extras[v] for v in ("vx", "vy", "vz")], -1), velocities, atol=1e-6)


def test_the_file_is_the_one_that_splat_viewers_read(tmp_path, gaussians):
    g = gaussians(2, 4)
    data = write_gaussians(tmp_path / "a.ply", g).read_bytes()
    header, body = data.split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property float")]
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"] + [f"f_rest_{i}" for i in range(9)]
    assert names == [*expected, "opacity", *(f"scale_{a}" for a in range(3)), *(f"rot_{a}" for a in range(4))]
    row = dict(zip(names, np.frombuffer(body, "<f4", len(names))))
    assert row["scale_1"] == pytest.approx(np.log(g.scales[0, 1]), rel=1e-6)
    assert row["opacity"] == pytest.approx(np.log(g.opacities[0] / (1 - g.opacities[0])), rel=1e-4)
    assert row["rot_0"] == pytest.approx(g.quats[0, 0])
    assert row["f_rest_3"] == pytest.approx(g.sh[0, 1, 1])  # green begins after the three coefficients of red


def test_a_turned_frame_shows_the_same_colours_from_the_same_side(tmp_path, gaussians):
    g = gaussians(20, 16)
    data = write_gaussians(tmp_path / "a.ply", g, axes="y_down").read_bytes().replace(b"axes y_down", b"axes z_up  ")
    (tmp_path / "b.ply").write_bytes(data)
    turned = read_gaussians(tmp_path / "b.ply")  # taken as it stands in the file
    directions = np.random.default_rng(2).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here = np.einsum("nk,nkc->nc", harmonics.basis(directions, 3), g.sh)
    there = np.einsum("nk,nkc->nc", harmonics.basis(directions @ AXES["y_down"].T, 3), turned.sh)
    np.testing.assert_allclose(there, here, atol=1e-5)  # float32 sums of 16 terms
    np.testing.assert_allclose(turned.means[:, 1], -g.means[:, 2], atol=1e-6)  # up is minus y


def test_opacities_of_0_and_1_stay_finite(tmp_path, gaussians):
    g = gaussians(3)
    g = Gaussians(g.means, g.quats, g.scales, np.array([0.0, 1.0, 0.5]), g.sh)
    np.testing.assert_allclose(read_gaussians(write_gaussians(tmp_path / "a.ply", g)).opacities, [0, 1, 0.5], atol=2e-6)


def test_no_splats_at_all_is_a_file_too(tmp_path):
    assert len(read_gaussians(write_gaussians(tmp_path / "a.ply", Gaussians.empty()))) == 0


def test_big_endian_files_are_read(tmp_path, gaussians):
    g = gaussians(5, 1)
    header, body = write_gaussians(tmp_path / "a.ply", g).read_bytes().split(b"end_header\n", 1)
    swapped = np.frombuffer(body, "<f4").astype(">f4").tobytes()
    (tmp_path / "b.ply").write_bytes(header.replace(b"little", b"big") + b"end_header\n" + swapped)
    np.testing.assert_allclose(read_gaussians(tmp_path / "b.ply").means, g.means)


def _bad_files(good: bytes) -> dict[str, tuple[bytes, str]]:
    huge = good.replace(b"element vertex 50", b"element vertex 99999999999999")
    ascii_header = good.replace(b"binary_little_endian", b"ascii")
    return {
        "too short": (good[:-10], "promises"),
        "huge count": (huge, "promises"),
        "negative count": (good.replace(b"vertex 50", b"vertex -5"), "cannot be understood"),
        "text": (ascii_header, "binary PLY"),
        "not ply": (b"hello", "not a PLY"),
        "no end": (good[:200], "not a PLY"),
        "unknown type": (good.replace(b"float opacity", b"quark opacity"), "cannot be understood"),
        "other names": (good.replace(b"opacity", b"opaqueR"), "missing opacity"),
        "not finite": (good[:-8] + np.float32([np.nan, np.nan]).tobytes(), "finite"),
        "end only in a comment": (good.replace(b"end_header", b"comment end_header", 1), "not a PLY|understood"),
        "two elements of one name": (
            good.replace(b"end_header", b"element vertex 1\nproperty float x\nend_header", 1),
            "two elements",
        ),
        "a name twice": (good.replace(b"float ny", b"float nx"), "cannot be understood"),
        "a count of a thousand digits": (good.replace(b"vertex 50", b"vertex " + b"9" * 1000), "promises"),
        "a count of too many digits": (good.replace(b"vertex 50", b"vertex " + b"9" * 9000), "cannot be understood"),
        "a list in place of a number": (
            good.replace(b"property float x\n", b"property list uchar float x\n") + bytes(900),
            "lists as x",
        ),
        "no rotation": (good[:-16] + bytes(16), "1 of 50 .*rotations"),
        "too few harmonics": (good.replace(b"float nx", b"float f_rest_0"), "1 of f_rest"),
        "no properties": (b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nend_header\n", "properties"),
    }


@pytest.mark.parametrize("case", list(_bad_files(b"")))
def test_bad_files_are_refused(tmp_path, gaussians, case):
    good = write_gaussians(tmp_path / "a.ply", gaussians(50, 1)).read_bytes()
    data, reason = _bad_files(good)[case]
    (tmp_path / "bad.ply").write_bytes(data)
    with pytest.raises(InputRejected, match=reason):
        read_gaussians(tmp_path / "bad.ply")


def _columns(path):
    """Header, and the one float record of every splat, of a file without integer properties."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property")]
    return header + b"end_header\n", np.frombuffer(body, [(name, "<f4") for name in names]).copy()


@pytest.mark.parametrize("what", ["scales", "opacities", "scales and opacities"])
def test_numbers_that_are_activated_already_are_found_and_named(tmp_path, gaussians, what):
    g = gaussians(3000, 4)
    header, records = _columns(write_gaussians(tmp_path / "a.ply", g))
    if "scales" in what:
        for a in range(3):
            records[f"scale_{a}"] = g.scales[:, a]
    if "opacities" in what:
        records["opacity"] = g.opacities
    (tmp_path / "b.ply").write_bytes(header + records.tobytes())
    with pytest.raises(InputRejected, match=f"the {what} of 'b.ply' are already activated"):
        read_gaussians(tmp_path / "b.ply")
    if what == "scales and opacities":
        back = read_splats(tmp_path / "b.ply", activated=True).gaussians
        np.testing.assert_array_equal(back.scales, g.scales)
        np.testing.assert_array_equal(back.opacities, g.opacities)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 300.0])
@pytest.mark.parametrize("opacity", [0.6, 0.95])
def test_an_honest_body_of_any_size_is_not_taken_for_activated(tmp_path, scale, opacity):
    rng = np.random.default_rng(4)
    g = Gaussians.isotropic(scale * rng.uniform(-1, 1, (300, 3)), 0.05 * scale, rng.uniform(0, 1, (300, 3)), opacity)
    back = read_gaussians(write_gaussians(tmp_path / "a.ply", g))
    np.testing.assert_allclose(back.scales, g.scales, rtol=1e-5)


def test_broken_splats_are_counted_by_fault_and_left_out_on_request(tmp_path, gaussians):
    g = gaussians(50, 4)
    header, records = _columns(write_gaussians(tmp_path / "a.ply", g))
    records["x"][3], records["scale_1"][7], records["f_rest_2"][7] = np.nan, np.inf, np.nan
    (tmp_path / "b.ply").write_bytes(header + records.tobytes())
    with pytest.raises(InputRejected, match=r"2 of 50 splats.*1 with broken positions, 1 with broken sc"):
        read_gaussians(tmp_path / "b.ply")
    back = read_splats(tmp_path / "b.ply", drop_broken=True).gaussians
    np.testing.assert_allclose(back.means, np.delete(g.means, [3, 7], axis=0))


def test_a_logit_that_overflowed_is_a_full_opacity(tmp_path, gaussians):
    header, records = _columns(write_gaussians(tmp_path / "a.ply", gaussians(20)))
    records["opacity"][:2] = np.inf, -np.inf
    (tmp_path / "b.ply").write_bytes(header + records.tobytes())
    opacities = read_gaussians(tmp_path / "b.ply").opacities
    np.testing.assert_allclose(opacities[:2], [1.0, 0.0], atol=1e-20)  # the logit is cut at 60


def test_harmonics_that_lie_coefficient_by_coefficient_are_put_in_order(tmp_path, gaussians):
    g = gaussians(20, 16)
    header, records = _columns(write_gaussians(tmp_path / "a.ply", g))
    for i, column in enumerate(g.sh[:, 1:].reshape(20, 45).T):  # red, green, blue of the first, of the second, ...
        records[f"f_rest_{i}"] = column
    (tmp_path / "b.ply").write_bytes(header + records.tobytes())
    np.testing.assert_array_equal(read_splats(tmp_path / "b.ply", coefficient_major=True).gaussians.sh, g.sh)


def test_a_file_with_y_down_is_read_upright_if_its_axes_are_told(tmp_path, gaussians):
    g = gaussians(20, 9)
    path = write_gaussians(tmp_path / "a.ply", g, axes="y_down")
    path.write_bytes(path.read_bytes().replace(b"fluidlift splats", b"somebody's splats"))
    back = read_splats(path, axes="y_down").gaussians
    np.testing.assert_allclose(back.means, g.means, atol=1e-6)
    np.testing.assert_allclose(back.sh, g.sh, atol=1e-5)  # float32, turned there and back


def test_a_file_read_in_parts_is_the_file(tmp_path, gaussians, monkeypatch):
    g = gaussians(50, 9)
    path = write_gaussians(tmp_path / "a.ply", g, ids=np.arange(50))
    whole = read_splats(path)
    monkeypatch.setattr("fluidlift.io.ply.PART", 7)
    parts = read_splats(path)
    np.testing.assert_array_equal(parts.gaussians.sh, whole.gaussians.sh)
    np.testing.assert_array_equal(parts.extras["id"], np.arange(50))


def test_ten_million_splats_take_the_memory_of_their_result(tmp_path):
    import tracemalloc

    n = 10_000_000
    names = [*"xyz", "opacity"] + [f"{a}_{i}" for a, k in (("f_dc", 3), ("scale", 3), ("rot", 4)) for i in range(k)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property char {name}" for name in names] + ["end_header\n"]
    path = tmp_path / "big.ply"
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        for _ in range(10):
            file.write(bytes([60, 70, 80, 9, 127, 0, 20, 255, 254, 250, 3, 1, 2, 0]) * (n // 10))
    tracemalloc.start()
    g = read_gaussians(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(g) == n
    assert peak < 2.2 * 56 * n  # the result takes 56 bytes each; the columns of one step of its making once more


def test_more_splats_than_are_read_are_refused_before_they_are(tmp_path, gaussians, monkeypatch):
    path = write_gaussians(tmp_path / "a.ply", gaussians(50))
    monkeypatch.setattr("fluidlift.io.ply.MAX_SPLATS", 49)
    with pytest.raises(InputRejected, match=r"50 splats.*at most 49"):
        read_gaussians(path)


def test_meshes_come_back(tmp_path, mesh):
    back = read_mesh(write_mesh(tmp_path / "m.ply", mesh, velocities=np.ones((4, 3))))
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_allclose(back.colors, mesh.colors, atol=0.5 / 255 + 1e-6)  # 8 bits


def test_meshes_with_wrong_indices_are_refused(tmp_path, mesh):
    path = write_mesh(tmp_path / "m.ply", mesh)
    path.write_bytes(path.read_bytes()[:-4] + np.int32(99).tobytes())
    with pytest.raises(InputRejected, match="missing vertices"):
        read_mesh(path)
    path.write_bytes(path.read_bytes()[:-13] + b"\x04" + bytes(12))
    with pytest.raises(InputRejected, match="triangles"):
        read_mesh(path)


def test_trimesh_reads_our_points_and_meshes(tmp_path, mesh):
    trimesh = pytest.importorskip("trimesh")
    loaded = trimesh.load(write_mesh(tmp_path / "m.ply", mesh), process=False)
    np.testing.assert_array_equal(loaded.vertices, mesh.vertices)
    np.testing.assert_array_equal(loaded.faces, mesh.faces)
    cloud = trimesh.load(write_points(tmp_path / "p.ply", mesh.vertices, colors=mesh.colors))
    np.testing.assert_array_equal(cloud.vertices, mesh.vertices)
