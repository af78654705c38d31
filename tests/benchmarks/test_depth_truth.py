from dataclasses import replace

import numpy as np
import pytest
import true_depth
from depth_errors import DepthErrors, depth_errors
from pydrake.math import RigidTransform
from true_depth import TrueDepth, frames_along_flight, ghosts_along_flight

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.world_registry import make_spec, make_world
from splatpilot.systems.collision.shapes import AnalyticDistanceField
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.scene import GaussianScene

CAMERA = OnboardCamera(64, 36)


@pytest.mark.parametrize("scenario", ["P04", "P10", "P11"])
def test_rays_end_where_the_distance_is_zero_and_meet_nothing_before(scenario):
    config = load_config(Scenario(), scenario_file(scenario))
    spec = replace(make_spec(config.world, 0), surroundings=list)
    X_WC = RigidTransform(spec.p_WS) @ CAMERA.X_BC()
    depth = TrueDepth(spec).image(CAMERA, X_WC)
    hit = np.isfinite(depth)
    assert hit.mean() > 0.4
    rays_W = CAMERA.ray_slopes()[hit] @ X_WC.rotation().matrix().T
    shapes = [solid.shape for solid in (*spec.solids, *spec.scenery)]
    field = AnalyticDistanceField(shapes, np.full(3, -500.0), np.full(3, 500.0))
    p_WQ = X_WC.translation() + depth[hit][:, None] * rays_W
    np.testing.assert_allclose(field.distance(p_WQ), 0, atol=3e-3)
    for part in np.linspace(0.02, 0.98, 25):
        before = X_WC.translation() + part * depth[hit][:, None] * rays_W
        assert field.distance(before).min() > -3e-3


def test_scenery_has_no_truth():
    config = load_config(Scenario(), scenario_file("P04"))
    spec = make_spec(config.world, 0)
    X_WC = RigidTransform(spec.p_WG - (4, 0, 0)) @ CAMERA.X_BC()  # the end is in sight
    bare = TrueDepth(replace(spec, surroundings=list)).image(CAMERA, X_WC)
    truth = TrueDepth(spec).image(CAMERA, X_WC)
    unknown = np.isnan(truth) & ~np.isnan(bare)
    assert unknown.mean() > 0.1
    assert not unknown[bare < 5].any()
    np.testing.assert_array_equal(truth[~unknown], bare[~unknown])


def test_depth_that_ends_in_free_space_is_a_ghost(monkeypatch):
    config = load_config(Scenario(), scenario_file("P04"))
    assert ghosts_along_flight(config, CAMERA, 4).max() == 0.0
    world = make_world(config.world, config.seed)
    wall = GaussianScene.from_colors(
        means=[world.p_WS + np.array([6.0, 0.0, 0.0])],
        quats=[[1.0, 0, 0, 0]],
        scales=[[0.02, 40.0, 40.0]],
        opacities=[0.99],
        colors=[[0.5, 0.5, 0.5]],
    )
    haunted = replace(world, gaussians=world.gaussians.merged_with(wall))
    monkeypatch.setattr(true_depth, "make_world", lambda *_: haunted)
    shares = ghosts_along_flight(config, CAMERA, 4)
    assert shares[0] > 0.3
    assert shares[-1] == 0.0  # It lies behind.


def test_a_camera_in_a_furnished_room_sees_what_is_there():
    config = load_config(Scenario(), scenario_file("P10"))
    frames = frames_along_flight(config, [CAMERA], 12)[0]
    errors = depth_errors(frames, CAMERA.max_depth)
    assert errors["all"].pixels == 12 * 64 * 36
    assert errors["all"].too_near + errors["all"].too_far <= 0.005
    assert abs(errors["all"].bias) <= 0.005
    assert errors["elsewhere"].too_near + errors["elsewhere"].too_far <= 0.001


def test_each_error_is_counted():
    truth = np.full(120, 2.0)
    truth[100:] = np.nan
    depth = 1.01 * truth
    depth[100:] = 0.3
    depth[:10] = 1.8  # too near
    depth[10:13] = 0.0  # nearer than the camera sees
    depth[15:18] = 2.3  # too far
    depth[18:20] = np.inf  # a hole
    errors = DepthErrors.of(depth, truth, 20.0)
    assert errors.pixels == 100 and errors.left_out == pytest.approx(20 / 120)
    shares = errors.too_near, errors.far_too_near, errors.too_far, errors.holes
    assert shares == pytest.approx((0.13, 0.03, 0.05, 0.02))
