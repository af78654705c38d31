import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.diagrams.flight.flight import Outcome, flight_outcome
from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.scene_folder import close_frontier
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.depth_fusion import esdf_from_depth_images
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_camera import ranged_depth
from splatpilot.systems.vehicle.quadrotor import hover_state

SIZE = np.array([6.0, 4.0, 3.0])  # [m]
K = np.array([[80.0, 0.0, 80.0], [0.0, 80.0, 60.0], [0.0, 0.0, 1.0]])
VOXEL = 0.1  # [m]


def looking(yaw: float, p_WC: list[float]) -> RigidTransform:
    """A level camera (x right, y down, z forward) that looks along `yaw` from p_WC."""
    R_BC = RollPitchYaw(-np.pi / 2, 0.0, -np.pi / 2).ToRotationMatrix()
    return RigidTransform(RollPitchYaw(0.0, 0.0, yaw).ToRotationMatrix() @ R_BC, p_WC)


def rays(X_WC: RigidTransform) -> np.ndarray:
    """(120, 160, 3) of depth 1, in W."""
    x, y = np.meshgrid((np.arange(160) - 79.5) / 80.0, (np.arange(120) - 59.5) / 80.0)
    return np.stack([x, y, np.ones_like(x)], -1) @ X_WC.rotation().matrix().T


def room_depth(X_WC: RigidTransform) -> np.ndarray:
    """(120, 160) [m] to the walls of an empty room between the origin and SIZE."""
    with np.errstate(divide="ignore"):
        ways = np.stack([(end - X_WC.translation()) / rays(X_WC) for end in (np.zeros(3), SIZE)])
    return ways.max(axis=0).min(axis=-1).astype(np.float32)


@pytest.fixture(scope="module")
def captured() -> tuple[Esdf, list[np.ndarray], list[RigidTransform]]:
    """The room from two poses at its near end that look along it, one of them askew."""
    X_WCs = [looking(0.0, [0.3, 2.0, 1.5]), looking(0.5, [0.3, 1.0, 1.5])]
    depths = [room_depth(X_WC) for X_WC in X_WCs]
    field = esdf_from_depth_images(depths, K, X_WCs, np.full(3, -0.4), SIZE + 0.4, VOXEL)
    return field, depths, X_WCs


@pytest.fixture(scope="module")
def closed(captured) -> tuple[Esdf, GaussianScene]:
    field, depths, X_WCs = captured
    closed, frontier = close_frontier(field, depths, K, X_WCs)
    assert frontier is not None
    return closed, frontier


def seen_depth(frontier: GaussianScene, X_WC: RigidTransform) -> np.ndarray:
    """(120, 160) [m], what a depth camera sees of the frontier."""
    return ranged_depth(BakedScene(frontier).render(K, 160, 120, X_WC).depth, 0.0, 50.0)


def test_frontier_hides_nothing_that_was_captured(captured, closed):
    _, depths, X_WCs = captured
    for depth, X_WC in zip(depths, X_WCs, strict=True):
        assert np.mean(seen_depth(closed[1], X_WC) < depth - 0.1) < 0.005


def test_what_was_captured_beyond_the_range_of_the_field_is_not_hidden(captured):
    _, depths, X_WCs = captured
    box = np.full(3, -0.4), SIZE + 0.4
    field = esdf_from_depth_images(depths, K, X_WCs, *box, VOXEL, max_range=3.0)
    _, frontier = close_frontier(field, depths, K, X_WCs)
    assert frontier is not None
    for depth, X_WC in zip(depths, X_WCs, strict=True):
        assert np.mean(seen_depth(frontier, X_WC) < depth - 0.1) < 0.005
    aside = looking(np.pi, [2.8, 2.0, 1.5])  # back into the corners beside the cameras
    assert np.mean(np.isfinite(seen_depth(frontier, aside))) > 0.5


def test_frontier_is_seen_where_it_is_hit(captured, closed):
    field, (distances, frontier) = captured[0], closed
    missed, ends = 0, 0
    for yaw in np.arange(4) * np.pi / 2:
        X_WC = looking(yaw, [2.8, 2.0, 1.5])
        way, depth = rays(X_WC), np.zeros((120, 160))
        p_WQ = np.tile(X_WC.translation(), (120, 160, 1))
        for _ in range(60):
            depth += 0.7 * np.clip(np.nan_to_num(distances.distance(p_WQ)), 0.0, None)
            p_WQ = X_WC.translation() + depth[..., None] * way
        at_frontier = (np.abs(distances.distance(p_WQ)) < 0.02) & (field.distance(p_WQ) > 0.1)
        ends += at_frontier.sum()
        missed += (at_frontier & (seen_depth(frontier, X_WC) > depth + 2 * VOXEL)).sum()
    assert ends > 5000
    assert missed < 0.01 * ends
    assert len(frontier) < 1000


def test_touching_the_frontier_is_a_collision(captured, closed):
    scenario = Scenario(policy=policy_named("straight"))
    p_WS, p_WG = np.array([2.8, 2.0, 1.5]), np.array([4.0, 2.0, 1.5])
    hidden_W = [0.7, 2.0, 0.3]  # beside the near camera, below all it saw
    ended = []
    for field in (captured[0], closed[0]):
        world = World("room", closed[1], field, field, (0.0, 0.0, 0.0), p_WS, p_WG)
        diagram = BuildFlightDiagram(scenario, world, camera=False)
        context = diagram.CreateDefaultContext()
        plant = diagram.GetSubsystemByName("plant")
        for p_WB in (hidden_W, p_WS):
            plant.GetMyMutableContextFromRoot(context).SetContinuousState(hover_state(p_WB))
            ended.append(flight_outcome(diagram, context, p_WG, 0.3))
    assert ended == [Outcome.LEFT_VOLUME, None, Outcome.COLLISION, None]


def test_closed_place_is_left_as_it_is(captured):
    field = captured[0]
    known = Esdf(np.abs(field.distances) + 0.4, 0 * field.states, field.lower_W, VOXEL)
    assert close_frontier(known, [], K, []) == (known, None)
