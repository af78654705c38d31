import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.training.captures.capture import Capture
from splatpilot.training.reconstruction.initialize import triangulate

WIDTH, HEIGHT, DEPTH = 320, 240, 2.0
K = np.array([[280.0, 0, 160], [0, 280.0, 120], [0, 0, 1]])


def posters() -> Capture:
    """Five views of a plane at z = 2 m with soft blobs of texture, from cameras that slide along
    it."""
    rng = np.random.default_rng(0)
    coarse = rng.uniform(0, 255, (120, 160, 3)).astype(np.uint8)
    X_WCs = [
        RigidTransform(RotationMatrix.MakeYRotation(-0.05 * i), [0.12 * i, 0.03 * i, 0.0])
        for i in range(5)
    ]

    def load_image(i: int) -> np.ndarray:
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
        ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)])
        direction = np.einsum("ij,jhw->ihw", X_WCs[i].rotation().matrix(), ray)
        origin = X_WCs[i].translation()
        x, y, _ = origin[:, None, None] + direction * (DEPTH - origin[2]) / direction[2]
        # 2.5 cm a cell; bilinear, by hand.
        column, row = (x + 1.6) / 0.025, (y + 1.4) / 0.025
        c, r = np.clip(column.astype(int), 0, 158), np.clip(row.astype(int), 0, 118)
        a, b = (column - c)[..., None], (row - r)[..., None]
        top = coarse[r, c] * (1 - a) + coarse[r, c + 1] * a
        bottom = coarse[r + 1, c] * (1 - a) + coarse[r + 1, c + 1] * a
        return np.clip(top * (1 - b) + bottom * b, 0, 255).astype(np.uint8)

    return Capture("posters", "five posters", K, WIDTH, HEIGHT, X_WCs, load_image)


def test_points_lie_on_the_plane():
    """Points triangulated from images and poses alone lie on the plane they show, in its colours,
    and all over it; the same images give the same points."""
    capture = posters()
    points = triangulate(capture, range(5))
    x, y, z = points.p_WQ.T
    assert len(z) > 200
    assert np.median(np.abs(z - DEPTH)) < 0.005
    assert np.ptp(x) > 1.5 and np.ptp(y) > 1.0
    image = capture.load_image(0)
    u = np.round(K[0, 0] * x / z + K[0, 2] - 0.5).astype(int)
    v = np.round(K[1, 1] * y / z + K[1, 2] - 0.5).astype(int)
    seen = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
    difference = np.abs(points.colors[seen] - image[v[seen], u[seen]] / 255)
    assert np.median(difference) < 0.1
    again = triangulate(capture, range(5))
    np.testing.assert_array_equal(points.p_WQ, again.p_WQ)


def test_frames_left_out_are_not_asked_for():
    """Only the numbered frames are read."""
    capture = posters()
    asked = []

    def load_image(i):
        asked.append(i)
        return capture.load_image(i)

    spy = Capture("p", "p", K, WIDTH, HEIGHT, capture.X_WCs, load_image)
    triangulate(spy, [0, 2, 3])
    assert asked == [0, 2, 3]


def test_too_little_texture():
    """Images without texture are refused with the number of points found."""
    capture = posters()
    gray = Capture(
        "gray",
        "gray walls",
        K,
        WIDTH,
        HEIGHT,
        capture.X_WCs,
        lambda i: np.full((HEIGHT, WIDTH, 3), 128, np.uint8),
    )
    with pytest.raises(ValueError, match="gray walls: only 0 points can be triangulated"):
        triangulate(gray, range(5))
