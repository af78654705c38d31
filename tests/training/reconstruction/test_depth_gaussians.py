import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.reconstruction.initialize import (
    BlockMeans,
    cell_gaussians,
    frame_gaussians,
    principal_axes,
)

HEIGHT, WIDTH, F = 48, 64, 50.0
K = np.array([[F, 0, WIDTH / 2], [0, F, HEIGHT / 2], [0, 0, 1]])
X_WC = RigidTransform(RollPitchYaw(0.3, -0.2, 1.0), np.array([1.0, 2.0, 3.0]))
GREY = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
ALL = np.ones((HEIGHT, WIDTH), bool)


def plane_frame(normal_C, distance: float) -> CaptureFrame:
    """Depth of the plane normal . p = distance, seen by a camera at X_WC."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / F, (v - HEIGHT / 2) / F, np.ones_like(u)], axis=-1)
    depth = distance / (rays @ np.asarray(normal_C))
    return CaptureFrame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth.astype(np.float32), X_WC, K)


def covered(cells) -> np.ndarray:
    """How many cells lie over each pixel."""
    count = np.zeros((HEIGHT, WIDTH), int)
    for u, v, size in zip(cells.u, cells.v, cells.size, strict=True):
        rows = slice(int(v - size / 2), int(v + size / 2))
        count[rows, int(u - size / 2) : int(u + size / 2)] += 1
    return count


def test_plain_plane_takes_the_largest_cells():
    """A slanted plane of one colour is covered once by cells of the largest size."""
    frame = plane_frame([0.5, 0.2, 0.8], 1.6)
    cells = BlockMeans(frame, GREY, ALL, 8).split(0.05, 8, 0.75, 9)
    assert set(cells.size) == {8}
    assert (covered(cells) == 1).all()


def test_texture_and_edges_take_small_cells():
    """Cells shrink to 2 pixels at a line in the texture, and to 1 at a step in depth."""
    frame = plane_frame([0, 0, 1], 2.0)
    depth = frame.depth.copy()
    depth[:, 41:] = 3.0
    frame = CaptureFrame(frame.image, depth, X_WC, K)
    image = GREY.copy()
    image[20] = 0.1
    cells = BlockMeans(frame, image, ALL, 8).split(0.05, 8, 0.75, 9)
    assert (covered(cells) == 1).all()
    on_step = np.abs(cells.u - 41) < 1
    assert set(cells.size[on_step]) == {1}
    on_line = (np.abs(cells.v - 20.5) < cells.size / 2 + 0.1) & (np.abs(cells.u - 20) < 10)
    assert set(cells.size[on_line]) == {2}
    assert set(cells.size[(cells.v > 32) & (cells.u < 32)]) == {8}


def test_only_wanted_pixels_with_depth_are_covered():
    """Pixels that are not wanted, or without depth, get no cell."""
    frame = plane_frame([0, 0, 1], 2.0)
    depth = frame.depth.copy()
    depth[:4], depth[4:8] = 0, np.inf
    wanted = ALL.copy()
    wanted[:, 32:] = False
    cells = BlockMeans(CaptureFrame(frame.image, depth, X_WC, K), GREY, wanted, 8).split(
        1, 8, 0.75, 9
    )
    count = covered(cells)
    assert (count[8:, :32] == 1).all()
    assert count[:8].sum() == count[:, 32:].sum() == 0


def test_sizes_that_are_no_multiple_of_the_cells_are_covered():
    """Images whose sides are no multiple of the largest cell are covered to the border."""
    frame = plane_frame([0, 0, 1], 2.0)
    frame = CaptureFrame(frame.image[:-3, :-5], frame.depth[:-3, :-5], X_WC, K)
    cells = BlockMeans(frame, GREY[:-3, :-5], ALL[:-3, :-5], 16).split(1, 16, 0.75, 9)
    assert (covered(cells)[:-3, :-5] == 1).all()


def test_gaussians_lie_flat_on_the_plane():
    """On a slanted plane, centres are on it and covariances thin across and wide along it."""
    normal_C = np.array([0.5, 0.2, 0.8])
    normal_C /= np.linalg.norm(normal_C)
    frame = plane_frame(normal_C, 1.6)
    cells = BlockMeans(frame, GREY, ALL, 4).split(0.05, 4, 0.75, 9)
    p_WQ, covariances = cell_gaussians(frame, cells, spread=0.5)
    p_CQ = X_WC.inverse().multiply(p_WQ.T).T
    np.testing.assert_allclose(p_CQ @ normal_C, 1.6, atol=1e-5)
    normal_W = X_WC.rotation().matrix() @ normal_C
    across = np.sqrt(np.einsum("i,nij,j->n", normal_W, covariances, normal_W))
    variances = np.linalg.eigvalsh(covariances)
    np.testing.assert_allclose(across, np.sqrt(variances[:, 0]), rtol=1e-3)
    assert (across < 0.25 * np.sqrt(variances[:, 1])).all()


def test_gaussians_cover_their_cell_in_the_image():
    """Projected into the image, a Gaussian's covariance is that of `spread` times its cell."""
    frame = plane_frame([0.3, -0.4, 0.85], 2.0)
    cells = BlockMeans(frame, GREY, ALL, 4).split(0.05, 4, 0.75, 9)
    p_WQ, covariances = cell_gaussians(frame, cells, spread=0.5)
    R_CW = X_WC.rotation().matrix().T
    p_CQ = X_WC.inverse().multiply(p_WQ.T).T
    for (x, y, z), covariance in zip(p_CQ, R_CW @ covariances @ R_CW.T, strict=True):
        J = F / z * np.array([[1, 0, -x / z], [0, 1, -y / z]])
        np.testing.assert_allclose(
            J @ covariance @ J.T, np.diag([(0.5 * 4) ** 2] * 2), rtol=0.02, atol=0.08
        )


def test_cells_do_not_extend_too_far():
    """No cell is longer on its surface than the given part of its depth, unless a single pixel."""
    frame = plane_frame([0.6, 0, 0.8], 1.0)
    cells = BlockMeans(frame, GREY, ALL, 16).split(1, 16, 0.75, 0.1)
    assert (covered(cells) == 1).all()
    _, covariances = cell_gaussians(frame, cells, spread=1)
    longest = np.sqrt(np.linalg.eigvalsh(covariances)[:, 2])
    large = cells.size > 1
    assert large.any()
    # The edges of a cell are not at right angles on the surface: its longest axis may be more.
    assert (longest[large] < np.sqrt(2) * 0.1 / cells.w[large]).all()


def test_underlay_lies_behind_and_closes_gaps():
    """Wide Gaussians 3 % behind the surface accompany the narrow ones on it."""
    wide = K * np.array([[10, 1, 1], [1, 10, 1], [1, 1, 1]])
    depth = np.full((HEIGHT, WIDTH), 2, np.float32)
    frame = CaptureFrame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth, X_WC, wide)
    p_WQ, covariances, colors = frame_gaussians(frame, GREY, ALL, 0.05, 4, 1.0)
    z = X_WC.inverse().multiply(p_WQ.T)[2]
    surface, under = np.abs(z - 2) < 1e-5, np.abs(z - 2.06) < 1e-5
    assert (surface.sum(), under.sum(), len(z)) == (12 * 16, 6 * 8, 12 * 16 + 6 * 8)
    widths = np.sqrt(np.linalg.eigvalsh(covariances)[:, 1:])
    np.testing.assert_allclose(widths[surface].mean(), 0.4 * 4 * 2 / (10 * F), rtol=0.01)
    np.testing.assert_allclose(widths[under].mean(), 0.6 * 8 * 2.06 / (10 * F), rtol=0.01)
    np.testing.assert_allclose(colors, 0.5)


def test_principal_axes_rebuild_the_covariance():
    """Quaternions and standard deviations give back the covariances they come from."""
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(50, 3, 3))
    covariances = axes @ axes.transpose(0, 2, 1)
    quats, scales = principal_axes(covariances)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1)
    for quat, scale, covariance in zip(quats, scales, covariances, strict=True):
        R = RotationMatrix(Quaternion(quat)).matrix()
        np.testing.assert_allclose(R @ np.diag(scale**2) @ R.T, covariance, atol=1e-10)


def test_principal_axes_of_a_flat_covariance_have_some_thickness():
    """A covariance without thickness gives scales that are all positive."""
    _, scales = principal_axes(np.diag([0.0, 1.0, 4.0])[None])
    assert (scales > 0).all()
    assert scales.max() == pytest.approx(2)


def test_third_principal_axis_is_the_normal():
    """Of flat covariances the third axis is the one across, and the rotations are proper."""
    rng = np.random.default_rng(0)
    R, _ = np.linalg.qr(rng.normal(size=(20, 3, 3)))
    covariances = R @ np.diag([0.04, 1e-6, 0.01]) @ R.transpose(0, 2, 1)
    quats, scales = principal_axes(covariances)
    np.testing.assert_allclose(scales, [[0.2, 0.1, 1e-3]] * 20, rtol=1e-3)
    w, x, y, z = quats.T
    normal = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w**2 - x**2 - y**2 + z**2], axis=1)
    np.testing.assert_allclose(np.abs((normal * R[:, :, 1]).sum(axis=1)), 1, atol=1e-6)
