"""What a small file of a stranger may cost: it is refused, or read in little memory, before anything is built."""

from __future__ import annotations

import json
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from fuzz.corpus import glb_file, scene_with_picture

from fluidlift.errors import InputRejected
from fluidlift.io import pictures, read_mesh
from fluidlift.io.array_archive import mapped_array, release_pages
from fluidlift.io.confined import reading_here
from fluidlift.io.exr import channels_in
from fluidlift.io.images import read_depth
from fluidlift.io.limits import MAX_DEPTH, ReadLimits, parse_json
from fluidlift.io.picture_headers import picture_header
from fluidlift.io.pictures import picture_in, read_picture
from fluidlift.io.read_mesh import read_any_mesh


@pytest.fixture
def memory():
    """Peak of what is allocated during a test, MB; NumPy tells tracemalloc."""
    with reading_here():
        tracemalloc.start()
        yield lambda: tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()


def png(width: int, height: int, rows: int | None = None) -> bytes:
    """A picture of one colour, packed to next to nothing, or its beginning."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(1 + width)) for _ in range(rows or height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def jpeg_behind(padding: int) -> bytes:
    """A JPEG that claims 65000 px a side behind that many segments of 64 kB."""
    _, data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))
    data = data.tobytes()
    at = data.index(b"\xff\xc0")
    large = data[: at + 5] + struct.pack(">HH", 65000, 65000) + data[at + 9 :]
    return large[:2] + (b"\xff\xe2\xff\xff" + bytes(65533)) * padding + large[2:]


def tiff(width: int, height: int) -> bytes:
    """A TIFF without pixels whose directory stands behind 100 kB."""
    tags = [(256, width), (257, height), (258, 8), (277, 3), (322, 64), (323, 64)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return b"II*\0" + struct.pack("<I", 100_008) + bytes(100_000) + struct.pack("<H", len(tags)) + entries + bytes(4)


def webp(width: int, height: int) -> bytes:
    """The header of a WebP with a large canvas."""
    canvas = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return b"RIFF" + struct.pack("<I", 22) + b"WEBPVP8X" + struct.pack("<II", 10, 0) + canvas


@pytest.mark.parametrize(
    "data", [png(60_000, 60_000, 100)[:4096], jpeg_behind(3), tiff(60_000, 60_000), webp(60_000, 60_000)],
    ids=["png", "jpeg", "tiff", "webp"],
)  # fmt: skip
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
def test_the_size_is_told_by_the_content_before_anything_is_decoded(tmp_path, memory, data, suffix):
    (tmp_path / f"a{suffix}").write_bytes(data)
    with pytest.raises(InputRejected, match=r"6\d000 x 6\d000 pixels"):
        read_picture(tmp_path / f"a{suffix}")
    assert memory() < 5


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [
        *((suffix, np.uint8) for suffix in (".png", ".jpg", ".tif", ".bmp", ".webp")),
        (".png", np.uint16),
        (".tif", np.uint16),
    ],
)
def test_headers_say_what_the_decoder_makes(suffix, dtype):
    _, data = cv2.imencode(suffix, np.full((7, 13, 3), 90, dtype))
    head = picture_header(data.tobytes())
    assert (head.width, head.height) == (13, 7)
    assert picture_in(data.tobytes(), "a", ReadLimits()).nbytes <= 13 * 7 * head.pixel_bytes


def test_a_picture_of_another_kind_than_its_name_is_read_as_what_it_is(tmp_path):
    (tmp_path / "a.exr").write_bytes(cv2.imencode(".png", np.full((4, 5, 3), 9, np.uint8))[1].tobytes())
    assert read_picture(tmp_path / "a.exr").shape == (4, 5, 3)
    (tmp_path / "b.png").write_bytes(b"P6 60000 60000 255\n")  # decoders know more kinds than these
    with pytest.raises(InputRejected, match="cannot be decoded"):
        read_picture(tmp_path / "b.png")


def exr(width: int, height: int, channels: int) -> bytes:
    """An OpenEXR header with nothing behind it."""
    listed = b"".join(b"c%d\0" % k + struct.pack("<iIii", 2, 0, 1, 1) for k in range(channels)) + b"\0"

    def attribute(name: bytes, value: bytes) -> bytes:
        return name + b"\0x\0" + struct.pack("<i", len(value)) + value

    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    parts = attribute(b"channels", listed) + attribute(b"compression", b"\3") + attribute(b"dataWindow", window)
    return struct.pack("<II", 0x01312F76, 2) + parts + b"\0"


@pytest.mark.parametrize("shape", [(6000, 5000, 60), (35_389_440, 1, 1), (1, 35_389_440, 3), (8192, 4320, 5)])
def test_an_exr_is_bounded_in_channels_and_sides(memory, shape):
    with pytest.raises(InputRejected, match=r"channels of|a side"):
        channels_in(exr(*shape), "a.exr", ReadLimits())
    assert memory() < 5


def test_depth_in_an_npz_is_taken_frame_by_frame(tmp_path, memory):
    np.savez_compressed(tmp_path / "a.npz", depth=np.ones((30, 1080, 1280), np.float32))  # 166 MB of 160 kB
    tracemalloc.reset_peak()
    assert read_depth(tmp_path / "a.npz", (32, 27)).shape == (30, 27, 32)
    assert memory() < 60
    np.savez_compressed(tmp_path / "b.npz", depth=np.ones((3000, 4, 4), np.float32))
    with pytest.raises(InputRejected, match="at most 2000 frames"):
        read_depth(tmp_path / "b.npz", (4, 4))


ZEROS = 400_000
"""bytes behind the data of the bombs"""


def bomb(change) -> bytes:
    """The textured triangle, its scene changed by `change(scene)`, and zeros in a view of their own."""
    scene, binary = scene_with_picture(4096)
    data = binary[8:] + bytes(ZEROS)
    scene["bufferViews"].append({"buffer": 0, "byteOffset": len(data) - ZEROS, "byteLength": ZEROS})
    change(scene)
    return glb_file(json.dumps(scene).encode(), struct.pack("<II", len(data), 0x004E4942) + data)


def shared_indices(scene):
    scene["accessors"][1] |= {"bufferView": 4, "count": ZEROS // 2}
    scene["meshes"][0]["primitives"] = scene["meshes"][0]["primitives"] * 1000


def instanced(scene):
    scene["nodes"] = [{"mesh": 0} for _ in range(9000)]
    scene["scenes"][0]["nodes"] = list(range(9000))
    scene["accessors"][0] |= {"bufferView": 4, "count": ZEROS // 12}
    scene["accessors"][2] |= {"bufferView": 4, "count": ZEROS // 12}


def many_materials(scene):
    scene["materials"] = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 0.5, k / 64, 1]}}
        for k in range(64)
    ]
    one = scene["meshes"][0]["primitives"][0]
    scene["meshes"][0]["primitives"] = [one | {"material": k} for k in range(64)]


@pytest.mark.parametrize("change", [shared_indices, instanced])
def test_what_is_shared_in_a_gltf_counts_each_time(tmp_path, memory, change):
    (tmp_path / "a.glb").write_bytes(bomb(change))
    with pytest.raises(InputRejected, match="more than"):
        read_any_mesh(tmp_path / "a.glb")
    assert memory() < 300


def test_materials_that_share_a_picture_decode_it_once(tmp_path, memory):
    (tmp_path / "a.glb").write_bytes(bomb(many_materials))
    mesh = read_any_mesh(tmp_path / "a.glb")
    assert max(mesh.texture.shape) <= 4096
    # the picture at full size, its float copy on the way, and the tiles of 512 px: not 64 pictures of 50 MB
    assert memory() < 400


def test_pictures_of_a_mesh_are_bounded_in_all(tmp_path, memory):
    data = png(8000, 4000)
    for k in range(20):
        (tmp_path / f"{k}.png").write_bytes(data)
    (tmp_path / "a.mtl").write_text("".join(f"newmtl m{k}\nmap_Kd {k}.png\n" for k in range(20)))
    faces = "".join(f"usemtl m{k}\nf 1/1 2/1 3/1\n" for k in range(20))
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n" + faces)
    with pytest.raises(InputRejected, match="20 pictures of 640000000 pixels in all"):
        read_any_mesh(tmp_path / "a.obj")
    assert memory() < 5


def test_lists_of_materials_are_bounded(tmp_path):
    (tmp_path / "a.mtl").write_text("".join(f"newmtl m{k}\n" for k in range(5000)))
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(InputRejected, match="more than 1024 materials"):
        read_any_mesh(tmp_path / "a.obj")


def test_polygons_of_an_obj_are_bounded(tmp_path, memory, monkeypatch):
    head = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    (tmp_path / "long.obj").write_text(head + "f " + "1 " * 2**20 + "\n")
    with pytest.raises(InputRejected, match="a line of"):
        read_any_mesh(tmp_path / "long.obj")
    monkeypatch.setattr(read_mesh, "MAX_TRIANGLES", 30_000)
    (tmp_path / "many.obj").write_text(head + ("f " + "1 " * 8_000 + "\n") * 4)
    with pytest.raises(InputRejected, match="more than 30000 triangles"):
        read_any_mesh(tmp_path / "many.obj")
    monkeypatch.setattr(read_mesh, "_MAX_LINES", 1000)
    (tmp_path / "empty.obj").write_text(head + "\n" * 1000)
    with pytest.raises(InputRejected, match="more than 1000 lines"):
        read_any_mesh(tmp_path / "empty.obj")
    assert memory() < 20


def test_numbers_of_json_that_no_reader_can_mean_are_infinite():
    assert parse_json("[1e999, -1" + "0" * 5000 + ", 9223372036854775807, 9223372036854775808]") == [
        float("inf"), float("-inf"), 2**63 - 1, 2.0**63,
    ]  # fmt: skip
    with pytest.raises(ValueError, match="nested"):
        parse_json("[" * 100_000)
    for depth, text in ((101, "[" * 101 + "]" * 101), (400, '{"a": ' * 400 + "1" + "}" * 400)):  # which Python reads
        assert json.loads(text)
        with pytest.raises(ValueError, match="nested too deeply"):
            parse_json(text)
        assert depth > MAX_DEPTH
    assert parse_json("[" * MAX_DEPTH + "]" * MAX_DEPTH) and parse_json("[" + "[]," * 500 + "[]]")
    with pytest.raises(ValueError, match="surrogates"):
        parse_json(r'{"name": ["a\ud800"]}')
    assert parse_json(r'"\ud83d\ude00"') == "\U0001f600"  # a whole pair


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
@pytest.mark.parametrize("channels", [(), (3,), (4,)])
def test_a_deep_picture_becomes_eight_bits_in_strips(memory, monkeypatch, dtype, channels):
    rng = np.random.default_rng(0)
    shape = (700, 900, *channels)
    deep = rng.uniform(-0.2, 1.2, shape).astype(dtype) if dtype == np.float32 else rng.integers(0, 2**16, shape, dtype)
    tracemalloc.reset_peak()
    before = memory()
    monkeypatch.setattr(pictures, "_STRIP", 10_000)
    found = pictures.eight_bit(deep)
    assert memory() - before < 3 * deep.size / 1e6 + 1.5
    monkeypatch.setattr(pictures, "_STRIP", 10**9)
    for strip, whole in zip(found, pictures.eight_bit(deep)):
        np.testing.assert_array_equal(strip, whole)


def test_pages_of_a_mapped_array_are_given_back_and_read_again(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(2**21, dtype=np.float32).reshape(2, -1))
    found = mapped_array(tmp_path / "a.npy")

    def held() -> int:
        """kB of the mapping that are in memory."""
        maps = Path("/proc/self/smaps").read_text().split("/a.npy")[1]
        return int(maps.split("Rss:")[1].split()[0])

    assert float(found[1].sum()) > 0
    if Path("/proc/self/smaps").exists():
        assert held() > 1000
        release_pages(found[None])
        assert held() < 100
    assert found[1, -1] == 2**21 - 1
