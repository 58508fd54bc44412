"""Grid maps as map_server writes them, and rays through them."""

from __future__ import annotations

import math
import os
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from linkpose.errors import LinkposeError
from linkpose.localization.grid import FREE, OCCUPIED, UNKNOWN, GridMap, cast_ray
from linkpose.localization.maps import load_map, save_map

YAML = (
    "image: map.pgm\nresolution: 0.1\norigin: [-1.0, 2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)


def room(width=100, height=60, cell=0.1, origin=(0.0, 0.0), yaw=0.0):
    """Free inside of walls one cell thick."""
    blocked = np.zeros((height, width), np.uint8)
    blocked[[0, -1], :] = 1
    blocked[:, [0, -1]] = 1
    return GridMap(blocked, np.array([cell, *origin, yaw]))


def cast(grid, x, y, angle, longest=80.0):
    return cast_ray(grid.blocked, grid.geometry, x, y, angle, longest)


def test_distances_are_exact_to_the_face_of_the_wall():
    grid = room()  # free from 0.1 to 9.9 and 0.1 to 5.9 m
    assert cast(grid, 5.03, 3.0, 0.0) == pytest.approx(4.87)
    assert cast(grid, 5.03, 3.0, math.pi) == pytest.approx(4.93)
    assert cast(grid, 5.03, 3.02, math.pi / 2) == pytest.approx(2.88)
    assert cast(grid, 5.03, 3.02, -math.pi / 2) == pytest.approx(2.92)
    assert cast(grid, 5.0, 3.0, math.radians(30)) == pytest.approx(4.9 / math.cos(math.radians(30)))
    assert cast(grid, 5.0, 3.0, math.radians(240)) == pytest.approx(2.9 / math.sin(math.radians(60)))
    assert cast(grid, 5.0, 3.0, 0.0, 2.0) == 2.0


def test_every_direction_agrees_with_geometry():
    grid, x, y = room(), 4.321, 2.345
    for angle in np.linspace(-math.pi, math.pi, 721):
        c, s = math.cos(angle), math.sin(angle)
        across = (9.9 - x if c > 0 else x - 0.1) / max(abs(c), 1e-12)
        along = (5.9 - y if s > 0 else y - 0.1) / max(abs(s), 1e-12)
        assert cast(grid, x, y, angle) == pytest.approx(min(across, along), abs=1e-9)


def test_a_moved_and_turned_map_gives_the_same_ranges():
    plain, turned = room(), room(origin=(-3.0, 7.0), yaw=0.6)
    c, s = math.cos(0.6), math.sin(0.6)
    for x, y, angle in ((1.0, 1.0, 0.2), (8.5, 5.0, -2.0), (5.0, 3.0, 1.6)):
        moved = cast(turned, -3.0 + c * x - s * y, 7.0 + s * x + c * y, angle + 0.6)
        assert moved == pytest.approx(cast(plain, x, y, angle), abs=1e-9)


def test_outside_and_inside_a_wall_the_range_is_zero():
    grid = room()
    assert cast(grid, -0.5, 3.0, 0.0) == 0.0
    assert cast(grid, 5.0, 6.5, 0.0) == 0.0
    assert cast(grid, 0.05, 3.0, 0.0) == 0.0


@pytest.mark.parametrize("name", ["map.pgm", "map.png"])
@pytest.mark.parametrize("negate", [0, 1])
def test_reads_what_map_server_writes(tmp_path, name, negate):
    """Top row of the image is the highest y; 0 is a wall, 254 free, 205 unknown, which stops a beam like a wall."""
    pixels = np.full((4, 6), 254, np.uint8)
    pixels[0, 5], pixels[3, 0] = 0, 205
    Image.fromarray(255 - pixels if negate else pixels).save(tmp_path / name)
    (tmp_path / "map.yaml").write_text(YAML.replace("map.pgm", name).replace("negate: 0", f"negate: {negate}"))
    grid = load_map(tmp_path / "map.yaml")
    assert grid.geometry.tolist() == [0.1, -1.0, 2.0, 0.0]
    assert grid.size_m == pytest.approx((0.6, 0.4))
    blocked = np.zeros((4, 6))
    blocked[3, 5], blocked[0, 0] = OCCUPIED, UNKNOWN
    assert (grid.blocked == blocked).all()


def test_a_saved_map_reads_back(tmp_path):
    occupied = room().blocked.astype(bool)
    save_map(tmp_path / "room.yaml", occupied, 0.1, (-2.0, 1.5))
    grid = load_map(tmp_path / "room.yaml")
    assert (grid.blocked == occupied).all()
    assert grid.geometry.tolist() == [0.1, -2.0, 1.5, 0.0]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("image: [map.pgm\n", "not YAML"),
        ("P5 2 2 255 ....", "names no image"),
        (YAML.replace("resolution: 0.1", "resolution: 0"), "resolution is 0"),
        (YAML.replace("resolution: 0.1", "resolution: ten"), "resolution is 'ten'"),
        (YAML.replace("resolution: 0.1\n", ""), "resolution is None"),
        (YAML.replace("[-1.0, 2.0, 0.0]", "[-1.0, .nan, 0.0]"), "origin"),
        (YAML.replace("[-1.0, 2.0, 0.0]", "5"), "origin is 5"),
        (YAML.replace("free_thresh: 0.196", "free_thresh: 0.9"), "free_thresh 0.9"),
        (YAML.replace("map.pgm", "gone.pgm"), "gone.pgm"),
        (YAML.replace("map.pgm", "map.yaml"), "no image that can be read"),
        (YAML.replace("negate: 0", "negate: 1"), "no cell of the map is free"),
        (YAML.replace("map.pgm", "cut.pgm"), "damaged or cut short"),
    ],
)
def test_a_bad_map_is_named_with_the_cure(tmp_path, text, reason):
    save_map(tmp_path / "map.yaml", np.zeros((4, 6), bool), 0.1, (0.0, 0.0))
    (tmp_path / "cut.pgm").write_bytes((tmp_path / "map.pgm").read_bytes()[:20])
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(LinkposeError, match=reason) as failure:
        load_map(tmp_path / "map.yaml")
    assert "map.yaml" in str(failure.value)


def test_a_map_that_is_not_there(tmp_path):
    with pytest.raises(LinkposeError, match="No such file"):
        load_map(tmp_path / "map.yaml")


def shown(tmp_path, image, **keys):
    """The cells of a one-row map with these pixels."""
    image.save(tmp_path / "map.png")
    text = YAML.replace("map.pgm", "map.png")
    for key, value in keys.items():
        text = "".join(line for line in text.splitlines(True) if not line.startswith(key)) + f"{key}: {value}\n"
    (tmp_path / "map.yaml").write_text(text)
    return load_map(tmp_path / "map.yaml").blocked[0].tolist()


def row_of(pixels, dtype=np.uint8):
    return Image.fromarray(np.array([pixels], dtype))


def test_images_of_other_depths_and_with_alpha(tmp_path):
    wall_free = [OCCUPIED, FREE, UNKNOWN]
    assert shown(tmp_path, row_of([0, 65000, 52685], np.uint16)) == wall_free
    assert shown(tmp_path, row_of([[0, 255], [254, 255], [254, 0]])) == wall_free  # grey and alpha
    assert shown(tmp_path, row_of([[0, 0, 0, 255], [254, 254, 254, 255], [0, 0, 0, 9]])) == wall_free
    assert shown(tmp_path, Image.fromarray(np.array([[False, True]])).convert("1")) == [OCCUPIED, FREE]
    assert shown(tmp_path, row_of([0, 254, 205]).convert("P")) == wall_free


def test_what_pillow_warns_of_is_not_shown(tmp_path, recwarn):
    """A PNG whose chunk for animations is wrong is a picture all the same."""
    row_of([0, 254, 205]).save(tmp_path / "map.png")
    content = (tmp_path / "map.png").read_bytes()
    at = content.index(b"IDAT") - 4
    chunk = b"acTL" + bytes(8)
    wrong = struct.pack(">I", 8) + chunk + struct.pack(">I", zlib.crc32(chunk))
    (tmp_path / "map.png").write_bytes(content[:at] + wrong + content[at:])
    (tmp_path / "map.yaml").write_text(YAML.replace("map.pgm", "map.png"))
    assert load_map(tmp_path / "map.yaml").blocked[0].tolist() == [OCCUPIED, FREE, UNKNOWN]
    assert not recwarn.list


def test_words_numbers_and_modes_of_a_map_file(tmp_path):
    assert shown(tmp_path, row_of([0, 254]), negate='"0"', resolution="1e-1") == [OCCUPIED, FREE]
    assert shown(tmp_path, row_of([0, 254]), negate="true") == [FREE, OCCUPIED]
    assert shown(tmp_path, row_of([0, 100, 50, 255]), mode="raw") == [FREE, OCCUPIED, UNKNOWN, UNKNOWN]
    assert shown(tmp_path, row_of([0, 254, 128]), mode="scale") == [OCCUPIED, FREE, UNKNOWN]
    with pytest.raises(LinkposeError, match="mode is 'tri'"):
        shown(tmp_path, row_of([0, 254]), mode="tri")


def test_a_map_without_a_wall_or_in_degrees_is_refused(tmp_path):
    with pytest.raises(LinkposeError, match="no cell of the map is a wall"):
        shown(tmp_path, row_of([254, 254]))
    with pytest.raises(LinkposeError, match=r"in degrees, write 1\.5708"):
        shown(tmp_path, row_of([0, 254]), origin="[0, 0, 90]")


def test_hostile_map_files_are_refused_at_once(tmp_path):
    row_of([0, 254]).save(tmp_path / "map.pgm")
    digits = "9" * 400
    bomb = "a: &a [x,x,x,x,x,x,x,x]\n" + "".join(
        f"{n}: &{n} [{','.join([f'*{m}'] * 8)}]\n" for m, n in zip("abcdefgh", "bcdefghi", strict=True)
    )
    for text, reason in (
        (YAML.replace("[-1.0, 2.0, 0.0]", f"[-1.0, {digits}, 0]"), "origin is"),
        (YAML.replace("resolution: 0.1", f"resolution: {digits}"), "resolution is 999"),
        (YAML.replace("resolution: 0.1", "resolution: 1e200"), "resolution is 1e"),
        (YAML.replace("2.0", "9" * 5000), "not YAML"),
        (bomb + YAML, "aliases"),
        ("[" * 5000, "not YAML"),
        ("#" * 70000, "larger than 65536 bytes"),
    ):
        (tmp_path / "map.yaml").write_text(text)
        with pytest.raises(LinkposeError, match=reason) as failure:
            load_map(tmp_path / "map.yaml")
        assert len(str(failure.value)) < 600


def test_an_image_that_is_no_file_or_too_large_is_refused(tmp_path):
    os.mkfifo(tmp_path / "map.pgm")
    (tmp_path / "map.yaml").write_text(YAML)
    with pytest.raises(LinkposeError, match="no regular file"):
        load_map(tmp_path / "map.yaml")
    (tmp_path / "map.pgm").unlink()
    (tmp_path / "map.pgm").write_bytes(b"P5 30000 30000 255\n")
    with pytest.raises(LinkposeError, match="30000 x 30000 cells"):
        load_map(tmp_path / "map.yaml")
