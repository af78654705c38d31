import os
from pathlib import Path

import numpy as np
import pytest

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.octomap import read_octomap

FREE, OCCUPIED, UNKNOWN, _ = FieldState
FREE_LEAF, OCCUPIED_LEAF, INNER = 1, 2, 3


def node(**children: int) -> int:
    """The 16 bits of an inner node with children given as c0=..., c7=..."""
    return sum(kind << 2 * int(name[1]) for name, kind in children.items())


def content(masks, count, resolution=0.5, kind="OcTree") -> bytes:
    header = f"# Octomap OcTree binary file\n# a comment\nid {kind}\nsize {count}\n"
    header += f"res {resolution}\ndata\n"
    return header.encode() + np.array(masks, "<u2").tobytes()


def deep_tree() -> bytes:
    """A tree with an occupied voxel at (0, 0, 0), a free one at (1, 0, 0), a free cube of 2 voxels
    an edge at (2, 0, 0) and one of 2^15 at the lowest corner of the space.

    In depth-first order: root, then child 7 of the root down to level 14, whose child 0 is the cube
    of two voxels an edge at the origin and child 1 a free leaf of that size.
    """
    masks = [node(c0=FREE_LEAF, c7=INNER)]
    masks += [node(c0=INNER)] * 13
    masks += [node(c0=INNER, c1=FREE_LEAF)]
    masks += [node(c0=OCCUPIED_LEAF, c1=FREE_LEAF)]
    return content(masks, count=len(masks) + 4)


@pytest.fixture
def path(tmp_path) -> Path:
    """A file of the deep tree."""
    (tmp_path / "map.bt").write_bytes(deep_tree())
    return tmp_path / "map.bt"


def test_a_tree_written_by_hand(path):
    octomap = read_octomap(path)
    assert octomap.resolution == 0.5
    rows = octomap.corners.tolist(), octomap.sizes.tolist(), octomap.occupied.tolist()
    low = -(2**15)
    assert sorted(zip(*rows, strict=True)) == [
        ([low, low, low], 2**15, False),
        ([0, 0, 0], 1, True),
        ([1, 0, 0], 1, False),
        ([2, 0, 0], 2, False),
    ]


def test_axes_of_the_children(path):
    branch = [node(c0=INNER)] * 14
    # Two inner children of the root, 3 (+x +y -z) and 6 (-x +y +z), with a voxel at the corner.
    masks = [node(c3=INNER, c6=INNER)]
    masks += [*branch, node(c0=OCCUPIED_LEAF), *branch, node(c7=FREE_LEAF)]
    path.write_bytes(content(masks, count=len(masks) + 2))
    octomap = read_octomap(path)
    low = -(2**15)
    np.testing.assert_array_equal(octomap.corners, [[0, 0, low], [low + 1, 1, 1]])
    np.testing.assert_array_equal(octomap.occupied, [True, False])


def test_grid_and_distance_field(path):
    lower, upper = np.array([-0.5, 0.0, 0.0]), np.array([2.0, 1.0, 1.0])
    expected = np.full((5, 2, 2), UNKNOWN)
    expected[1, 0, 0], expected[2, 0, 0], expected[3:] = OCCUPIED, FREE, FREE
    field = read_octomap(path).esdf(lower, upper)
    np.testing.assert_array_equal(field.lower_W, lower)
    np.testing.assert_array_equal(field.states, expected)
    assert -0.5 < field.distance([0.25, 0.25, 0.25]) <= -0.25  # so that its corners are solid
    assert field.distance([1.75, 0.25, 0.25]) == pytest.approx(1.25, abs=0.05)


def test_boxes_too_large_or_empty_are_refused(path):
    with pytest.raises(ValueError, match=r"at most 2\.5e\+08 voxels, .*a smaller box"):
        read_octomap(path).esdf()
    with pytest.raises(ValueError, match="upper_W must be"):
        read_octomap(path).esdf(np.ones(3), np.zeros(3))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda c: c[:-2], "octree must be 32 bytes, got 30"),
        (lambda c: c + b"\0\0", "octree must be 32 bytes, got 34"),
        (lambda _: content([node(c0=INNER)] * 16 + [node(c0=FREE_LEAF)], 18), "at most 16, got"),
        (lambda c: c.replace(b"size 20", b"size 21"), "number of nodes must be .* 21, got 20"),
        (lambda c: c.replace(b"res 0.5\n", b""), "header must have id, size and res"),
        (lambda c: c.replace(b"res 0.5", b"res -1"), "res must be .* got -1.0"),
        (lambda c: c.replace(b"OcTree\n", b"ColorOcTree\n"), "id must be OcTree, got Color"),
        (lambda c: c.replace(b"# Octomap", b"# Octopus"), "start must be .* OctoMap"),
        (lambda c: b"version https://git-lfs\n", "the pointer of git-LFS to a file"),
    ],
)
def test_damaged_and_foreign_files_are_refused(path, damage, message):
    path.write_bytes(damage(deep_tree()))
    with pytest.raises(ValueError, match=f"{path}.*{message}"):
        read_octomap(path)


@pytest.mark.skipif("SPLATPILOT_DATA" not in os.environ, reason="needs SPLATPILOT_DATA")
@pytest.mark.parametrize(
    ("name", "resolution", "extent"),
    [
        ("fr_078_tidyup", 0.05, (12.8, 14.0, 4.7)),
        ("forest0", 0.1, (10.0, 10.0, 5.0)),
    ],
)
def test_real_maps(name, resolution, extent):
    octomap = read_octomap(Path(os.environ["SPLATPILOT_DATA"]) / "maps" / f"{name}.bt")
    assert octomap.resolution == resolution
    np.testing.assert_allclose(octomap.upper_W - octomap.lower_W, extent, atol=1e-6)
