from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from splatpilot.training.captures.capture import Capture, CaptureFrame
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.initialize import (
    BlockMeans,
    Detail,
    cell_gaussians,
    frame_gaussians,
    gaussians_from_depth,
    gaussians_from_points,
    held_out_frames,
    principal_axes,
    random_points,
    resolve_config,
    triangulate,
)
from splatpilot.training.reconstruction.photometry import ThinnedFrame, estimate_photometry

COARSE = {"contrast": 1.0, "max_cell": 16, "max_extent": 0.2}


class Frames:
    """A capture of so many frames, as far as settings depend on it."""

    points = None

    def __init__(self, count, has_depth, held_out=None):
        self.count, self.has_depth, self.held_out = count, has_depth, held_out

    def __len__(self):
        return self.count


@pytest.mark.parametrize(
    ("count", "has_depth", "asked", "expected"),
    [
        (71, True, -1, 2000),  # 62 of them are fitted: 1984 would be too few
        (160, True, -1, 140 * 32),
        (700, True, -1, 7000),
        (71, False, -1, 7000),
        (700, True, 123, 123),
        (71, True, 0, 0),
    ],
)
def test_steps_follow_the_images_that_are_fitted(count, has_depth, asked, expected):
    config = ReconstructConfig(iterations=asked)
    resolved = resolve_config(config, Frames(count, has_depth))  # pyright: ignore[reportArgumentType]
    assert resolved.iterations == expected
    assert resolved.initialization == ("depth" if has_depth else "random")


def test_no_gaussian_stands_infinitely_far(write_room, tmp_path):
    capture = read_capture(write_room(tmp_path / "room"))

    def with_sky(frame):
        depth = frame.depth.copy()
        depth[:10], depth[10:14] = np.inf, 1e4
        return replace(frame, depth=depth)

    detail = Detail(max_gaussians=100_000, optimized=True, **COARSE)
    scenes = []
    for frames in (list(capture.frames()), [with_sky(frame) for frame in capture.frames()]):
        photometry = estimate_photometry([ThinnedFrame.of(frame) for frame in frames], 0)
        scenes.append(gaussians_from_depth(frames, photometry, detail))
    whole, below = scenes
    assert 0 < len(below) < len(whole)
    assert np.abs(below.means).max() <= np.abs(whole.means).max() + 0.1


def test_too_many_surfaces_to_optimize_are_thinned_out(write_room, tmp_path, capsys):
    capture = read_capture(write_room(tmp_path / "room"))
    frames = list(capture.frames())
    photometry = estimate_photometry([ThinnedFrame.of(frame) for frame in frames], 0)
    detail = Detail(max_gaussians=100_000, optimized=True, **COARSE)
    every = gaussians_from_depth(frames, photometry, detail)
    assert "would cover" not in capsys.readouterr().err
    some = gaussians_from_depth(frames, photometry, replace(detail, max_gaussians=20))
    assert len(some) == 20 < len(every)
    message = capsys.readouterr().err
    assert "20 Gaussians cover " in message and f"; {len(every)} would cover" in message
    assert set(map(tuple, some.means)) <= set(map(tuple, every.means))
    assert np.linalg.norm(some.scales, axis=1).mean() > np.linalg.norm(every.scales, axis=1).mean()
    with pytest.raises(ValueError, match="20 Gaussians are too few"):
        gaussians_from_depth(frames, photometry, replace(detail, max_gaussians=20, optimized=False))


def test_masked_blob_has_no_part_in_gaussians(write_room, tmp_path):
    capture = read_capture(write_room(tmp_path / "room"))
    valid = np.ones((capture.height, capture.width), bool)
    valid[15:33, 20:44] = False
    masked = replace(
        capture,
        load_image=lambda i: np.where(
            valid[..., None], capture.load_image(i), np.uint8([255, 0, 255])
        ),
        load_valid=lambda i: valid,
    )
    frames = list(masked.frames())
    photometry = estimate_photometry([ThinnedFrame.of(frame) for frame in frames], 0)
    detail = Detail(max_gaussians=100_000, optimized=True, **COARSE)
    scene = gaussians_from_depth(frames, photometry, detail)
    _, colors = random_points(frames, 5000, 0.5, 8.0, seed=0)
    for found in (scene.base_colors, colors):
        magenta = (found[:, 0] > 0.95) & (found[:, 1] < 0.05) & (found[:, 2] > 0.95)
        assert len(found) > 500 and not magenta.any()


@pytest.mark.parametrize(
    ("asked", "own", "expected"),
    [
        (-1, None, [0, 8]),
        (-1, [3, 4], [3, 4]),
        (5, [3, 4], [0, 5]),
        (0, [3, 4], []),
    ],
)
def test_frames_held_out_are_those_of_the_files_unless_told_otherwise(asked, own, expected):
    config = ReconstructConfig(hold_out=asked)
    assert held_out_frames(Frames(10, True, own), config) == expected  # pyright: ignore[reportArgumentType]


def test_points_become_gaussians_of_their_spacing():
    p_WQ = np.stack(np.meshgrid(*[0.2 * np.arange(5)] * 3), axis=-1).reshape(-1, 3)
    colors = np.random.default_rng(0).uniform(size=p_WQ.shape)
    scene = gaussians_from_points(p_WQ, colors)
    np.testing.assert_allclose(scene.scales, 0.1, rtol=1e-5)
    np.testing.assert_allclose(scene.means, p_WQ, rtol=1e-6)
    np.testing.assert_allclose(scene.base_colors, colors, atol=1e-5)
    with pytest.raises(ValueError, match="3 points are too few"):
        gaussians_from_points(p_WQ[:3], colors[:3])


def test_random_points_lie_in_view(write_room, tmp_path):
    frame = read_capture(write_room(tmp_path / "room")).frame(2)
    p_WQ, colors = random_points([frame], 500, 0.5, 8.0, seed=1)
    assert p_WQ.shape == (500, 3)
    x, y, z = frame.X_WC.inverse().multiply(p_WQ.T)
    u, v = frame.K[0, 0] * x / z + frame.K[0, 2], frame.K[1, 1] * y / z + frame.K[1, 2]
    assert (0.5 <= z.min()) and (z.max() <= 8) and z.max() > 4
    np.testing.assert_array_equal(frame.image[v.astype(int), u.astype(int)], colors * 255)


HEIGHT, WIDTH, F = 48, 64, 50.0
K = np.array([[F, 0, WIDTH / 2], [0, F, HEIGHT / 2], [0, 0, 1]])
X_WC = RigidTransform(RollPitchYaw(0.3, -0.2, 1.0), np.array([1.0, 2.0, 3.0]))
GRAY = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
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
    frame = plane_frame([0.5, 0.2, 0.8], 1.6)
    cells = BlockMeans(frame, GRAY, ALL, 8).split(0.05, 8, 0.75, 9)
    assert set(cells.size) == {8}
    assert (covered(cells) == 1).all()


def test_texture_and_edges_take_small_cells():
    frame = plane_frame([0, 0, 1], 2.0)
    depth = frame.depth.copy()
    depth[:, 41:] = 3.0
    frame = CaptureFrame(frame.image, depth, X_WC, K)
    image = GRAY.copy()
    image[20] = 0.1
    cells = BlockMeans(frame, image, ALL, 8).split(0.05, 8, 0.75, 9)
    assert (covered(cells) == 1).all()
    on_step = np.abs(cells.u - 41) < 1
    assert set(cells.size[on_step]) == {1}
    on_line = (np.abs(cells.v - 20.5) < cells.size / 2 + 0.1) & (np.abs(cells.u - 20) < 10)
    assert set(cells.size[on_line]) == {2}
    assert set(cells.size[(cells.v > 32) & (cells.u < 32)]) == {8}


def test_only_wanted_pixels_with_depth_are_covered():
    frame = plane_frame([0, 0, 1], 2.0)
    depth = frame.depth.copy()
    depth[:4], depth[4:8] = 0, np.inf
    wanted = ALL.copy()
    wanted[:, 32:] = False
    cells = BlockMeans(CaptureFrame(frame.image, depth, X_WC, K), GRAY, wanted, 8).split(
        1, 8, 0.75, 9
    )
    count = covered(cells)
    assert (count[8:, :32] == 1).all()
    assert count[:8].sum() == count[:, 32:].sum() == 0


def test_sizes_that_are_no_multiple_of_the_cells_are_covered():
    frame = plane_frame([0, 0, 1], 2.0)
    frame = CaptureFrame(frame.image[:-3, :-5], frame.depth[:-3, :-5], X_WC, K)
    cells = BlockMeans(frame, GRAY[:-3, :-5], ALL[:-3, :-5], 16).split(1, 16, 0.75, 9)
    assert (covered(cells)[:-3, :-5] == 1).all()


def test_gaussians_lie_flat_on_the_plane():
    normal_C = np.array([0.5, 0.2, 0.8])
    normal_C /= np.linalg.norm(normal_C)
    frame = plane_frame(normal_C, 1.6)
    cells = BlockMeans(frame, GRAY, ALL, 4).split(0.05, 4, 0.75, 9)
    p_WQ, covariances = cell_gaussians(frame, cells, spread=0.5)
    p_CQ = X_WC.inverse().multiply(p_WQ.T).T
    np.testing.assert_allclose(p_CQ @ normal_C, 1.6, atol=1e-5)
    normal_W = X_WC.rotation().matrix() @ normal_C
    across = np.sqrt(np.einsum("i,nij,j->n", normal_W, covariances, normal_W))
    variances = np.linalg.eigvalsh(covariances)
    np.testing.assert_allclose(across, np.sqrt(variances[:, 0]), rtol=1e-3)
    assert (across < 0.25 * np.sqrt(variances[:, 1])).all()


def test_gaussians_cover_their_cell_in_the_image():
    frame = plane_frame([0.3, -0.4, 0.85], 2.0)
    cells = BlockMeans(frame, GRAY, ALL, 4).split(0.05, 4, 0.75, 9)
    p_WQ, covariances = cell_gaussians(frame, cells, spread=0.5)
    R_CW = X_WC.rotation().matrix().T
    p_CQ = X_WC.inverse().multiply(p_WQ.T).T
    for (x, y, z), covariance in zip(p_CQ, R_CW @ covariances @ R_CW.T, strict=True):
        J = F / z * np.array([[1, 0, -x / z], [0, 1, -y / z]])
        np.testing.assert_allclose(
            J @ covariance @ J.T, np.diag([(0.5 * 4) ** 2] * 2), rtol=0.02, atol=0.08
        )


def test_cells_do_not_extend_too_far():
    frame = plane_frame([0.6, 0, 0.8], 1.0)
    cells = BlockMeans(frame, GRAY, ALL, 16).split(1, 16, 0.75, 0.1)
    assert (covered(cells) == 1).all()
    _, covariances = cell_gaussians(frame, cells, spread=1)
    longest = np.sqrt(np.linalg.eigvalsh(covariances)[:, 2])
    large = cells.size > 1
    assert large.any()
    # The edges of a cell are not at right angles on the surface: its longest axis may be more.
    assert (longest[large] < np.sqrt(2) * 0.1 / cells.w[large]).all()


def test_underlay_lies_behind_and_closes_gaps():
    wide = K * np.array([[10, 1, 1], [1, 10, 1], [1, 1, 1]])
    depth = np.full((HEIGHT, WIDTH), 2, np.float32)
    frame = CaptureFrame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth, X_WC, wide)
    p_WQ, covariances, colors = frame_gaussians(frame, GRAY, ALL, 0.05, 4, 1.0)
    z = X_WC.inverse().multiply(p_WQ.T)[2]
    surface, under = np.abs(z - 2) < 1e-5, np.abs(z - 2.06) < 1e-5
    assert (surface.sum(), under.sum(), len(z)) == (12 * 16, 6 * 8, 12 * 16 + 6 * 8)
    widths = np.sqrt(np.linalg.eigvalsh(covariances)[:, 1:])
    np.testing.assert_allclose(widths[surface].mean(), 0.4 * 4 * 2 / (10 * F), rtol=0.01)
    np.testing.assert_allclose(widths[under].mean(), 0.6 * 8 * 2.06 / (10 * F), rtol=0.01)
    np.testing.assert_allclose(colors, 0.5)


def test_principal_axes_rebuild_the_covariance():
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(50, 3, 3))
    covariances = axes @ axes.transpose(0, 2, 1)
    quats, scales = principal_axes(covariances)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1)
    for quat, scale, covariance in zip(quats, scales, covariances, strict=True):
        R = RotationMatrix(Quaternion(quat)).matrix()
        np.testing.assert_allclose(R @ np.diag(scale**2) @ R.T, covariance, atol=1e-10)


def test_principal_axes_of_a_flat_covariance_have_some_thickness():
    _, scales = principal_axes(np.diag([0.0, 1.0, 4.0])[None])
    assert (scales > 0).all()
    assert scales.max() == pytest.approx(2)


def test_third_principal_axis_is_the_normal():
    rng = np.random.default_rng(0)
    R, _ = np.linalg.qr(rng.normal(size=(20, 3, 3)))
    covariances = R @ np.diag([0.04, 1e-6, 0.01]) @ R.transpose(0, 2, 1)
    quats, scales = principal_axes(covariances)
    np.testing.assert_allclose(scales, [[0.2, 0.1, 1e-3]] * 20, rtol=1e-3)
    w, x, y, z = quats.T
    normal = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w**2 - x**2 - y**2 + z**2], axis=1)
    np.testing.assert_allclose(np.abs((normal * R[:, :, 1]).sum(axis=1)), 1, atol=1e-6)


POSTER_WIDTH, POSTER_HEIGHT, POSTER_DEPTH = 320, 240, 2.0
POSTER_K = np.array([[280.0, 0, 160], [0, 280.0, 120], [0, 0, 1]])


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
        v, u = np.mgrid[0:POSTER_HEIGHT, 0:POSTER_WIDTH] + 0.5
        ray = np.stack(
            [
                (u - POSTER_K[0, 2]) / POSTER_K[0, 0],
                (v - POSTER_K[1, 2]) / POSTER_K[1, 1],
                np.ones_like(u),
            ]
        )
        direction = np.einsum("ij,jhw->ihw", X_WCs[i].rotation().matrix(), ray)
        origin = X_WCs[i].translation()
        x, y, _ = origin[:, None, None] + direction * (POSTER_DEPTH - origin[2]) / direction[2]
        # 2.5 cm a cell; bilinear, by hand.
        column, row = (x + 1.6) / 0.025, (y + 1.4) / 0.025
        c, r = np.clip(column.astype(int), 0, 158), np.clip(row.astype(int), 0, 118)
        a, b = (column - c)[..., None], (row - r)[..., None]
        top = coarse[r, c] * (1 - a) + coarse[r, c + 1] * a
        bottom = coarse[r + 1, c] * (1 - a) + coarse[r + 1, c + 1] * a
        return np.clip(top * (1 - b) + bottom * b, 0, 255).astype(np.uint8)

    return Capture(
        "posters", "five posters", POSTER_K, POSTER_WIDTH, POSTER_HEIGHT, X_WCs, load_image
    )


def test_points_lie_on_the_plane():
    capture = posters()
    points = triangulate(capture, range(5))
    x, y, z = points.p_WQ.T
    assert len(z) > 200
    assert np.median(np.abs(z - POSTER_DEPTH)) < 0.005
    assert np.ptp(x) > 1.5 and np.ptp(y) > 1.0
    image = capture.load_image(0)
    u = np.round(POSTER_K[0, 0] * x / z + POSTER_K[0, 2] - 0.5).astype(int)
    v = np.round(POSTER_K[1, 1] * y / z + POSTER_K[1, 2] - 0.5).astype(int)
    seen = (u >= 0) & (u < POSTER_WIDTH) & (v >= 0) & (v < POSTER_HEIGHT)
    difference = np.abs(points.colors[seen] - image[v[seen], u[seen]] / 255)
    assert np.median(difference) < 0.1
    again = triangulate(capture, range(5))
    np.testing.assert_array_equal(points.p_WQ, again.p_WQ)


def test_frames_left_out_are_not_asked_for():
    capture = posters()
    asked = []

    def load_image(i):
        asked.append(i)
        return capture.load_image(i)

    spy = Capture("p", "p", POSTER_K, POSTER_WIDTH, POSTER_HEIGHT, capture.X_WCs, load_image)
    triangulate(spy, [0, 2, 3])
    assert asked == [0, 2, 3]


def test_too_little_texture():
    capture = posters()
    gray = Capture(
        "gray",
        "gray walls",
        POSTER_K,
        POSTER_WIDTH,
        POSTER_HEIGHT,
        capture.X_WCs,
        lambda i: np.full((POSTER_HEIGHT, POSTER_WIDTH, 3), 128, np.uint8),
    )
    with pytest.raises(ValueError, match="gray walls: only 0 points can be triangulated"):
        triangulate(gray, range(5))
