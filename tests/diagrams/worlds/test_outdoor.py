import numpy as np
import pytest

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import scenario_file
from splatpilot.diagrams.worlds import feasibility, outdoor
from splatpilot.diagrams.worlds.indoor import RoomConfig
from splatpilot.diagrams.worlds.outdoor import BranchesConfig, ClutterConfig
from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.diagrams.worlds.world_registry import make_spec
from splatpilot.systems.collision.shapes import Box, Capsule
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS


def spec_of(name: str, seed: int) -> WorldSpec:
    return make_spec(load_config(Scenario(), scenario_file(name)).world, seed)


def free_widths(spec: WorldSpec) -> list[float]:
    """Widths in y of the free stretches in the planes through the middles of walls across."""
    widths = []
    boxes = [solid.shape for solid in spec.solids if isinstance(solid.shape, Box)]
    walls = {float(b.X_WO.translation()[0].round(6)) for b in boxes if np.isclose(b.size[0], 0.3)}
    y = np.arange(spec.lower_W[1], spec.upper_W[1], 0.005)
    for x in sorted(w for w in walls if 0 < w < spec.upper_W[0]):
        p = np.column_stack([np.full_like(y, x), y, np.full_like(y, 5.9)])
        free = spec.distance_field.distance(p) > 0
        edges = np.flatnonzero(np.diff(np.concatenate([[0], free, [0]])))
        widths += [0.005 * (b - a) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return widths


def test_walls_leave_the_configured_gaps():
    slits = free_widths(spec_of("P08", 1))
    np.testing.assert_allclose(slits, [1.4, 1.25, 1.1, 1.0], atol=0.012)
    np.testing.assert_allclose(free_widths(spec_of("P09", 1)), [3.6] * 4, atol=0.012)
    sides = free_widths(spec_of("P06", 1))
    assert sum(sides) == pytest.approx(2.0, abs=0.02) and max(sides) > 2 * VEHICLE_RADIUS + 0.5


def test_limbs_and_wires_are_thin_and_solid():
    spec = spec_of("P11", 2)
    thin = [s.shape for s in spec.solids if isinstance(s.shape, Capsule) and s.shape.radius < 0.05]
    assert len(thin) > 60
    assert all(0.02 <= 2 * shape.radius <= 0.04 for shape in thin)
    middles = np.array([(np.asarray(s.p_WA) + np.asarray(s.p_WB)) / 2 for s in thin])
    distance = spec.distance_field.distance(middles)
    assert (distance[np.isfinite(distance)] <= -0.0099).all()


def test_infeasible_draws_are_redrawn_and_given_up(monkeypatch):
    monkeypatch.setattr(feasibility, "TRIES", 2)
    full = ClutterConfig(length=8, width=4, height=3, spheres=0, boxes=200, half_min=0.6)
    with pytest.raises(InfeasibleFlightError, match=r"none of 2 instances .* seed 0 leaves a"):
        make_spec(full, 0)
    monkeypatch.setattr(outdoor, "is_feasible", lambda spec: False)
    with pytest.raises(InfeasibleFlightError, match=r"leave no route in \d+ draws from seed 0"):
        make_spec(BranchesConfig(length=8, width=5, height=3), 0)
    with pytest.raises(ValueError, match="seed must be"):
        make_spec(RoomConfig(), -1)
