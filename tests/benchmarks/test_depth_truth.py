from dataclasses import replace

import numpy as np
import pytest
from depth_truth import DepthFrame, TrueDepth, depth_errors, frames_along_flight
from pydrake.math import RigidTransform

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds.world_registry import make_spec
from splatpilot.systems.collision.shapes import AnalyticDistanceField
from splatpilot.systems.common.config import load_config
from splatpilot.systems.sensing.onboard_camera import OnboardCamera

CAMERA = OnboardCamera(64, 36)


@pytest.mark.parametrize("scenario", ["P04", "P10", "P11"])
def test_rays_end_where_the_distance_is_zero_and_meet_nothing_before(scenario):
    config = load_config(Scenario(), scenario_file(scenario))
    spec = replace(make_spec(config.world, 0), surroundings=list)
    X_WC = RigidTransform(spec.p_WS) @ CAMERA.mount()
    depth = TrueDepth(spec).image(CAMERA, X_WC)
    hit = np.isfinite(depth)
    assert hit.mean() > 0.4
    rays_W = depth[hit][:, None] * CAMERA.ray_slopes()[hit] @ X_WC.rotation().matrix().T
    shapes = [solid.shape for solid in (*spec.solids, *spec.scenery)]
    field = AnalyticDistanceField(shapes, np.full(3, -500.0), np.full(3, 500.0))
    np.testing.assert_allclose(field.distance(X_WC.translation() + rays_W), 0, atol=3e-3)
    for part in np.linspace(0.02, 0.98, 25):
        assert field.distance(X_WC.translation() + part * rays_W).min() > -3e-3


def test_camera_in_a_furnished_room_measures_the_truth():
    config = load_config(Scenario(), scenario_file("P10"))
    frames = frames_along_flight(config, [CAMERA], 4)[0]
    errors = depth_errors(frames, CAMERA.max_depth)
    assert errors.pixels == 4 * 64 * 36
    assert errors.wrong <= 0.005 and abs(errors.bias) <= 0.005
    assert depth_errors(frames, CAMERA.max_depth, edges=False).wrong <= 0.001


def test_each_error_is_counted():
    truth = np.full((4, 30), 2.0)
    truth[:, 25:] = np.nan
    depth = 1.01 * truth
    depth[:, 25:] = 0.3
    depth[0, :10] = 1.8  # too near
    depth[1, :3] = 0.0  # below the camera's minimum
    depth[2, :5] = 2.3, 2.3, 2.3, np.inf, np.inf  # too far, and holes
    errors = depth_errors([DepthFrame(depth, truth)], 20.0)
    assert errors == pytest.approx((100, 0.18, 0.01))
    truth[:, :15] = 4.0
    assert depth_errors([DepthFrame(depth, truth)], 20.0, edges=False).pixels == 4 * (12 + 7)
