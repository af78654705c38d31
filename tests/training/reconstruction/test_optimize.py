from dataclasses import replace

import numpy as np
import pytest
import torch
from pydrake.math import RigidTransform
from room import write_room_capture

from splatpilot.diagrams.worlds.scene_folder import read_scene, read_scene_metadata
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_files import read_ply
from splatpilot.training.captures.capture import CaptureFrame, SfmPoints, back_project, no_depth
from splatpilot.training.captures.capture_registry import read_capture
from splatpilot.training.reconstruction.checkpoint import Checkpoint
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.initialize import (
    gaussians_from_depth,
    gaussians_from_points,
    random_points,
)
from splatpilot.training.reconstruction.losses import photometric_loss
from splatpilot.training.reconstruction.metrics import HeldOutMetrics
from splatpilot.training.reconstruction.optimize import DefaultStrategy, Optimization, view_loss
from splatpilot.training.reconstruction.parameters import SplatParameters
from splatpilot.training.reconstruction.photometry import Photometry
from splatpilot.training.reconstruction.reconstruct import reconstruct
from splatpilot.training.reconstruction.splat_rendering import Rendering, render
from splatpilot.training.reconstruction.views import ReconstructionViews

CONFIG = ReconstructConfig(iterations=60, initial_gaussians=3000, image_width=0, hold_out=6)
CONFIG = replace(CONFIG, voxel_size=0.2, threads=1)


# A walk in small steps, with the held-out frames 0 and 6 in the middle of it.
POSES = [
    ((1.0 + 0.1 * i, 0.2 * np.sin(i), -1.2), -0.5 + 0.1 * i, -0.1)
    for i in (4, 0, 1, 2, 3, 5, 7, 6, 8, 9, 10, 11)
]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return read_capture(write_room_capture(tmp_path_factory.mktemp("room") / "room", poses=POSES))


def fit(capture, out, **changes) -> HeldOutMetrics:
    """Reconstructs and returns the metrics of the held-out frames."""
    return reconstruct(capture, out, replace(CONFIG, **changes)).held_out


@pytest.mark.parametrize(("representation", "count"), [("3dgs", 3000), ("2dgs", 8000)])
def test_held_out_frames_are_reconstructed(tmp_path, room, representation, count):
    # Surfels have no blur of pixels, so more are required.
    changes = {"representation": representation, "initial_gaussians": count}
    start = fit(room, tmp_path / "start", **changes, iterations=1).means()
    found = fit(room, tmp_path / "scene", **changes, iterations=150)
    assert found.means()["psnr_db"] > max(30, start["psnr_db"] + 2)
    assert found.means()["depth_mae_m"] < 0.1
    if representation == "3dgs":
        for view in found.views:
            assert view.hole_fraction is not None and view.hole_fraction < 0.005
        baked = read_scene(tmp_path / "scene").baked
        for frame in room.frames():
            alpha = baked.render(frame.K, 64, 48, frame.X_WC).alpha
            assert np.median(alpha) > 0.97 and np.mean(alpha < 0.5) < 0.02
    metadata = read_scene_metadata(tmp_path / "scene")
    assert (metadata.held_out, metadata.representation) == ([0, 6], representation)
    assert (metadata.capture, metadata.image_width) == (room.folder, 0)
    scales = read_ply(tmp_path / "scene" / "gaussians.ply").scales
    assert (scales[:, 2] < 2e-6).all() == (representation == "2dgs")


def test_scene_depends_only_on_the_seed(tmp_path, room):
    for name, threads in (("a", 1), ("b", 2)):
        config = replace(CONFIG, iterations=20, threads=threads)
        reconstruct(room, tmp_path / name, config)
    for file in ("gaussians.ply", "scene.yaml", "esdf.npz"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_gaussians_are_added_only_without_depth(tmp_path, room):
    def count(**changes) -> int:
        few = {"initial_gaussians": 300, "iterations": 30, "refine_start": 5, "refine_every": 10}
        return reconstruct(room, tmp_path / "scene", replace(CONFIG, **few | changes)).gaussians

    assert count(initialization="random") > 300
    assert count(initialization="random", strategy="none") == 300
    assert count() == count(strategy="none")


def test_depth_term_moves_gaussians_to_surfaces(tmp_path, room):
    changes = {"initialization": "random", "surface_weight": 0.0, "iterations": 100}
    without, found = (
        fit(room, tmp_path / "scene", **changes, depth_weight=weight).means()["depth_mae_m"]
        for weight in (0.0, 0.2)
    )
    assert 0 < found < 0.5 * without


def test_without_depth_from_points(tmp_path):
    factors = np.where(np.arange(12) % 3 == 1, 0.8, 1.0)
    dim = write_room_capture(
        tmp_path / "dim", poses=POSES, brightness=lambda i, rho: np.full(1, factors[i])
    )
    capture, p_WQ, colors = read_capture(dim), [], []
    rows, columns = np.mgrid[2:48:4, 2:64:4]
    for frame in capture.frames():
        p_CQ = back_project(frame.K, columns + 0.5, rows + 0.5, frame.depth[rows, columns])
        p_WQ.append(frame.X_WC.multiply(p_CQ.reshape(-1, 3).T).T)
        colors.append(frame.image[rows, columns].reshape(-1, 3) / 255)
    points = SfmPoints(np.concatenate(p_WQ), np.concatenate(colors))
    capture = replace(capture, load_depth=no_depth, points=points)
    found = fit(capture, tmp_path / "scene", iterations=250).means()
    assert list(found) == ["psnr_db"] and found["psnr_db"] > 32
    gains = np.array(read_scene_metadata(tmp_path / "scene").gains)
    fitted = np.arange(12) % 6 > 0  # frames 0 and 6 are held out
    np.testing.assert_allclose((gains / gains[2])[fitted], factors[fitted], rtol=0.03)
    np.testing.assert_array_equal(gains[~fitted], 1.0)  # which neighbors do not predict


def optimization(out, views, initial, fit_gains=False, **changes) -> Optimization:
    config = replace(CONFIG, **{"iterations": 200, "strategy": "none"} | changes)
    checkpoint, black = Checkpoint(out, config, views), (0.0, 0.0, 0.0)
    return Optimization(
        config, views, views, black, lambda _: initial, checkpoint, fit_gains=fit_gains
    )


def test_fitted_gains_leave_the_views_unchanged(tmp_path, room):
    frames = list(room.frames())
    views = ReconstructionViews(frames, Photometry(np.ones(len(frames)), 0.0))
    points = gaussians_from_points(*random_points(frames, 500, 0.5, 4.0, seed=0))
    run = optimization(tmp_path / "scene", views, points, True, iterations=10, depth_weight=0.0)
    run.run()
    assert (views.gains == 1).all()
    assert np.ptp(run.gains.numpy()) > 1e-3


def test_outline_weight_closes_holes_at_outlines(tmp_path):
    K = np.array([[40.0, 0, 32], [0, 40.0, 24], [0, 0, 1]])
    v, u = np.mgrid[:48, :64] + 0.5
    frames = []
    for x in np.linspace(-0.3, 0.3, 5):
        on_plate = (np.abs((u - 32) / 40 * 2 + x) < 0.8) & (np.abs((v - 24) / 40 * 2) < 0.6)
        image = np.where(on_plate[..., None], 150, 200).repeat(3, axis=2).astype(np.uint8)
        depth = np.where(on_plate, 2.0, np.inf).astype(np.float32)
        frames.append(CaptureFrame(image, depth, RigidTransform([x, 0, 0]), K))
    one = Photometry(np.ones(5), 0.0)
    views = ReconstructionViews(frames, one)
    cells = {"max_cell": 4, "max_extent": 0.2}
    start = gaussians_from_depth(frames, one, 300, 1.0, optimized=True, **cells)
    holes = []
    for weight in (0.0, 1.0):
        run = optimization(tmp_path / f"{weight}", views, start, outline_weight=weight)
        run.run()
        metrics = run.measure()
        assert metrics is not None
        holes.append(metrics.means()["hole_fraction"])
    assert holes[1] < holes[0]


def test_scene_of_unknown_scale_cannot_be_flown_in(tmp_path, room):
    capture = replace(room, metric=False)
    summary = reconstruct(capture, tmp_path / "scene", replace(CONFIG, iterations=5))
    assert "cannot be flown in: its scale is unknown" in str(summary)
    assert "units of an unknown length" in str(summary) and "[m]" not in str(summary)
    with pytest.raises(ValueError, match=r"scene\.yaml: metric must be true to fly, got false"):
        read_scene(tmp_path / "scene")


SMALL_K = torch.tensor([[[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]])
VIEWMAT = torch.eye(4)[None]


def three_gaussians(scales=(0.005, 0.5, 0.005), opacities=(0.9, 0.9, 0.9)) -> SplatParameters:
    means = [[-0.3, 0, 2.0], [0.3, 0, 2.0], [0.0, 0.3, 2.0]]
    sizes = np.repeat(scales, 3).reshape(3, 3)
    scene = GaussianScene.from_colors(means, [[1.0, 0, 0, 0]] * 3, sizes, opacities, np.eye(3))
    return SplatParameters.of_scene(scene, 0, "cpu")


def strategy_for(splats: SplatParameters, **changes) -> DefaultStrategy:
    fields = {"strategy": "default", "iterations": 100, "refine_start": 1, "refine_every": 1}
    fields |= {"reset_every": 0, "refine_fraction": 1.0, "max_gaussians": 100}
    return DefaultStrategy(ReconstructConfig(**fields | changes), torch.zeros(3), 1.0, len(splats))


def test_large_gradients_double_small_gaussians_and_split_large_ones():
    splats = three_gaussians()
    strategy = strategy_for(splats)
    strategy.gradients, strategy.counts = torch.tensor([1.0, 1.0, 0.0]), torch.ones(3)
    small, large, other = splats["means"].detach().clone()
    strategy.refine(1, splats)
    assert len(splats) == 5
    means, scales = splats["means"], splats.scales[:, 0]
    assert (means == small).all(dim=1).sum() == 2 and (means == other).all(dim=1).sum() == 1
    parts = torch.nonzero(scales > 0.1)[:, 0]
    np.testing.assert_allclose(scales[parts].detach(), [0.5 / 1.6] * 2, rtol=1e-6)
    distance = (means[parts] - large).norm(dim=1)
    assert (distance > 0).all() and (distance < 3).all()
    assert (splats.sh[parts] == splats.sh[parts[0]]).all()
    # Only the strongest grow up to the limit.
    splats = three_gaussians(scales=(0.005, 0.005, 0.005))
    strategy = strategy_for(splats, max_gaussians=4)
    strategy.gradients, strategy.counts = torch.tensor([1.0, 3.0, 2.0]), torch.ones(3)
    strategy.refine(1, splats)
    counts = (splats["means"][:, None] == three_gaussians()["means"]).all(dim=2).sum(dim=0)
    assert counts.tolist() == [1, 2, 1]


def test_faint_and_huge_gaussians_are_removed_and_opacities_reset():
    splats = three_gaussians(scales=(0.005, 0.5, 0.005), opacities=(0.9, 0.9, 0.004))
    strategy = strategy_for(splats, reset_every=2)
    strategy.refine(1, splats)
    assert len(splats) == 2
    strategy.refine(2, splats)
    np.testing.assert_allclose(splats.opacities.detach(), [0.01, 0.01], rtol=1e-4)
    strategy.refine(3, splats)
    assert splats.scales.max() < 0.01


@pytest.mark.parametrize("representation", ["3dgs", "2dgs"])
def test_gradients_are_by_position_on_the_image(representation):
    splats = three_gaussians(scales=(0.1, 0.1, 0.1))
    strategy = strategy_for(splats, representation=representation)
    torch.manual_seed(0)
    weights = torch.rand((48, 64, 3))

    def loss(means):
        gaussians = (means, splats["quats"], splats.scales, splats.opacities, splats.sh)
        rendering = render(representation, gaussians, VIEWMAT, SMALL_K, 64, 48)
        return rendering, (rendering.color * weights).sum()

    rendering, value = loss(splats["means"])
    strategy.watch(rendering)
    value.backward()
    strategy.observe(rendering, splats, VIEWMAT, SMALL_K)
    with torch.no_grad():
        for i in range(3):
            slope = []
            for axis, half in ((0, 32), (1, 24)):
                step = torch.zeros_like(splats["means"])
                step[i, axis] = 0.01 * splats["means"][i, 2] / 40  # a hundredth of a pixel
                change = loss(splats["means"] + step)[1] - loss(splats["means"] - step)[1]
                slope.append(change.item() / 0.02 * half)
            assert strategy.gradients[i].item() == pytest.approx(np.hypot(*slope), rel=0.3)


HEIGHT, WIDTH = 24, 32
LOSS_K = np.array([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])


def loss_and_gradient(color: np.ndarray, image: np.ndarray, valid: np.ndarray):
    """The loss of a rendered color (H, W, 3) against an image, and its gradient."""
    depth = np.where(valid, np.float32(2), np.float32(0))
    frame = CaptureFrame(image, depth, RigidTransform(), LOSS_K, valid)
    views = ReconstructionViews([frame], Photometry(np.ones(1), 0.0))
    rendered = torch.tensor(color, dtype=torch.float32, requires_grad=True)
    ones = torch.ones(HEIGHT, WIDTH)
    config = ReconstructConfig(surface_weight=0, depth_weight=0)
    rendering = Rendering(rendered, 2 * ones, ones, {})
    options = {"gain": torch.tensor(1.0), "background": torch.zeros(1, 3), "outlines": False}
    loss = view_loss(config, views, 0, rendering, (ones,) * 5, step=0, **options)
    loss.backward()
    assert rendered.grad is not None
    return loss.item(), rendered.grad.numpy()


def test_loss_is_photometric_over_valid_pixels():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    color, valid = rng.uniform(size=(HEIGHT, WIDTH, 3)), np.ones((HEIGHT, WIDTH), bool)
    loss, _ = loss_and_gradient(color, image, valid)
    pair = torch.tensor(color, dtype=torch.float32), torch.tensor(image).float() / 255
    assert loss == pytest.approx(photometric_loss(*pair).item(), rel=1e-6)
    valid[5:15, 8:20] = False
    blob = np.where(valid[..., None], image, np.uint8([255, 0, 0]))
    loss, gradient = loss_and_gradient(color, image, valid)
    other_loss, other_gradient = loss_and_gradient(color, blob, valid)
    assert loss == other_loss
    np.testing.assert_array_equal(gradient, other_gradient)
    assert not gradient[~valid].any() and gradient[valid].all()
