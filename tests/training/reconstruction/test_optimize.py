"""Reconstruction by optimisation, on a small room."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.diagrams.worlds.scene_folder import read_scene, read_scene_metadata
from splatpilot.systems.splats.splat_files import read_ply
from splatpilot.training.captures.capture import CaptureFrame, SfmPoints, no_depth
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction.checkpoint import Checkpoint
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.initialize import (
    Detail,
    gaussians_from_depth,
    gaussians_from_points,
    random_points,
)
from splatpilot.training.reconstruction.optimize import Optimization
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.reconstruct import reconstruct
from splatpilot.training.reconstruction.views import ReconstructionViews

CONFIG = ReconstructConfig(
    iterations=60,
    initial_gaussians=3000,
    image_width=0,
    hold_out=6,
    voxel_size=0.1,
    threads=1,
)


# A walk in small steps, with the frames 0 and 6, which will be withheld, in the midst of it.
POSES = [
    ((1.0 + 0.1 * i, 0.2 * np.sin(i), -1.2), -0.5 + 0.1 * i, -0.1)
    for i in (4, 0, 1, 2, 3, 5, 7, 6, 8, 9, 10, 11)
]


@pytest.fixture
def room(tmp_path, write_room):
    return write_room(tmp_path / "room", poses=POSES)


@pytest.mark.parametrize("representation", ["3dgs", "2dgs"])
def test_held_out_frames_come_out(tmp_path, room, representation):
    """Frames that nothing was fitted to are rendered with the right colours and depth."""
    # A surfel is blurred by no pixel, so more are needed.
    count = {"3dgs": 3000, "2dgs": 8000}[representation]
    config = replace(CONFIG, representation=representation, initial_gaussians=count, iterations=300)
    start = reconstruct(read_capture(room), tmp_path / "start", replace(config, iterations=1))
    summary = reconstruct(read_capture(room), tmp_path / "scene", config)
    assert start.held_out is not None and summary.held_out is not None
    assert summary.held_out.means()["psnr_db"] > max(30, start.held_out.means()["psnr_db"] + 2)
    assert summary.held_out.means()["depth_mae_m"] < 0.1
    metadata = read_scene_metadata(tmp_path / "scene")
    assert (metadata.held_out, metadata.representation) == ([0, 6], representation)
    assert (metadata.capture, metadata.image_width) == (str(room), 0)
    scales = read_ply(tmp_path / "scene" / "gaussians.ply").scales
    assert (scales[:, 2] < 2e-6).all() == (representation == "2dgs")


def test_same_seed_same_scene_whatever_the_threads(tmp_path, room):
    """Two runs with different numbers of threads end in the same bytes."""
    for name, threads in (("a", 1), ("b", 2)):
        config = replace(CONFIG, iterations=20, threads=threads)
        reconstruct(read_capture(room), tmp_path / name, config)
    for file in ("gaussians.ply", "scene.yaml", "esdf.npz"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_what_is_solid_is_opaque(tmp_path, room):
    """Withheld frames look the same before black as before anything else, whatever the colour of
    the walls, and none of their pixels is a hole."""
    summary = reconstruct(read_capture(room), tmp_path / "scene", replace(CONFIG, iterations=300))
    assert summary.held_out is not None
    for view in summary.held_out.views:
        assert view.hole_fraction is not None and view.hole_fraction < 0.005
    scene = read_scene(tmp_path / "scene")
    for frame in read_capture(room).frames():
        height, width = frame.depth.shape
        alpha = scene.baked.render(frame.K, width, height, frame.X_WC).alpha
        assert np.median(alpha) > 0.97 and np.mean(alpha < 0.5) < 0.02


def test_metric_depth_is_what_places_surfaces(tmp_path, room):
    """From random Gaussians, the depth term brings depth much nearer to the truth."""
    config = replace(CONFIG, initialization="random", initial_gaussians=3000, iterations=300)
    errors = []
    for weight in (0.0, 0.2):
        weighted = replace(config, depth_weight=weight, surface_weight=0.0)
        summary = reconstruct(read_capture(room), tmp_path / "scene", weighted)
        assert summary.held_out is not None
        errors.append(summary.held_out.means()["depth_mae_m"])
    assert 0 < errors[1] < 0.5 * errors[0]


def test_gaussians_are_added_where_depth_puts_none(tmp_path, room):
    """Left to itself, a reconstruction adds Gaussians where they start at random, but none where
    they start from depth."""
    config = replace(CONFIG, initial_gaussians=300, iterations=80, refine_start=5, refine_every=10)

    def count(**changes) -> int:
        return reconstruct(
            read_capture(room), tmp_path / "scene", replace(config, **changes)
        ).gaussians

    assert count(initialization="random") > 300
    assert count(initialization="random", strategy="none") == 300
    config = replace(config, initial_gaussians=3000)
    assert count() == count(strategy="none")


def test_without_depth_from_points(tmp_path, write_room):
    """A capture without depth is reconstructed from points: withheld images come out, and the gains
    of all images are found."""
    factors = np.where(np.arange(12) % 3 == 1, 0.8, 1.0)
    dim = write_room(
        tmp_path / "dim", poses=POSES, brightness=lambda i, rho: np.full(1, factors[i])
    )
    capture = read_capture(dim)
    rows, columns = np.mgrid[2:48:4, 2:64:4]
    p_WQ, colors = [], []
    for frame in capture.frames():
        p_CQ = frame.back_project(columns + 0.5, rows + 0.5, frame.depth[rows, columns])
        p_WQ.append(frame.X_WC.multiply(p_CQ.reshape(-1, 3).T).T)
        colors.append(frame.image[rows, columns].reshape(-1, 3) / 255)
    points = SfmPoints(np.concatenate(p_WQ), np.concatenate(colors))
    capture = replace(capture, load_depth=no_depth, points=points)
    summary = reconstruct(capture, tmp_path / "scene", replace(CONFIG, iterations=250))
    assert summary.held_out is not None
    assert list(summary.held_out.means()) == ["psnr_db"]
    assert summary.held_out.means()["psnr_db"] > 32
    gains = np.array(read_scene_metadata(tmp_path / "scene").gains)
    np.testing.assert_allclose(gains / gains[0], factors / factors[0], rtol=0.03)


def test_gains_that_are_fitted_leave_the_images_as_they_were(tmp_path, room):
    """The optimisation keeps the gains that it finds to itself."""
    frames = list(read_capture(room).frames())
    views = ReconstructionViews(frames, Photometry(np.ones(len(frames)), 0.0))
    config = replace(CONFIG, iterations=10, strategy="none", depth_weight=0.0)
    points = gaussians_from_points(*random_points(frames, 500, 0.5, 4.0, seed=0))
    checkpoint = Checkpoint(tmp_path / "scene", config, views)
    optimization = Optimization(
        config, views, None, (0.0, 0.0, 0.0), lambda: points, checkpoint, fit_gains=True
    )
    optimization.run()
    assert (views.gains == 1).all()
    assert np.ptp(optimization.gains.numpy()) > 1e-3


def test_what_stands_before_the_sky_is_kept_to_its_outline(tmp_path):
    """Seen through a depth camera, which has no blur, a plate before the sky is opaque up to its
    edge: with the outlines in the loss fewer of its pixels are holes than without."""
    K = np.array([[40.0, 0, 32], [0, 40.0, 24], [0, 0, 1]])
    v, u = np.mgrid[:48, :64] + 0.5
    frames = []
    for x in np.linspace(-0.3, 0.3, 5):
        on_plate = (np.abs((u - 32) / 40 * 2 + x) < 0.8) & (np.abs((v - 24) / 40 * 2) < 0.6)
        image = np.where(on_plate[..., None], 150, 200).repeat(3, axis=2).astype(np.uint8)
        depth = np.where(on_plate, 2.0, np.inf).astype(np.float32)
        frames.append(CaptureFrame(image, depth, RigidTransform([x, 0, 0]), K))
    views = ReconstructionViews(frames, Photometry(np.ones(5), 0.0))
    cells = {"contrast": 1.0, "max_cell": 4, "max_extent": 0.2}
    detail = Detail(max_gaussians=300, optimized=True, **cells)
    start = gaussians_from_depth(frames, Photometry(np.ones(5), 0.0), detail)
    holes = []
    for weight in (0.0, 1.0):
        config = replace(CONFIG, iterations=200, strategy="none", outline_weight=weight)
        checkpoint = Checkpoint(tmp_path / f"{weight}", config, views)
        run = Optimization(config, views, views, (0.0, 0.0, 0.0), lambda: start, checkpoint)
        run.run()
        measured = run.measure()
        assert measured is not None
        holes.append(measured.means()["hole_fraction"])
    assert holes[1] < holes[0]


def test_unknown_scale_is_never_flown_in(tmp_path, room):
    """A capture of unknown scale becomes a scene that says so and that `read_scene` refuses."""
    capture = replace(read_capture(room), metric=False)
    summary = reconstruct(capture, tmp_path / "scene", replace(CONFIG, iterations=5))
    assert "cannot be flown in: its scale is unknown" in str(summary)
    assert "units of an unknown length" in str(summary) and "[m]" not in str(summary)
    with pytest.raises(ValueError, match=r"scene\.yaml: the scale of this scene is unknown"):
        read_scene(tmp_path / "scene")


def test_what_a_capture_lacks_is_said(tmp_path, room):
    """Asked to start from points that are not there, it says what there is."""
    with pytest.raises(ValueError, match="initialization is 'points', but room has none; choose"):
        reconstruct(
            read_capture(room), tmp_path / "scene", replace(CONFIG, initialization="points")
        )
    assert not (tmp_path / "scene").exists()
