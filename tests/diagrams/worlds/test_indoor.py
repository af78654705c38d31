from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import label

from splatpilot.diagrams.worlds.feasibility import CLEARANCE, connects
from splatpilot.diagrams.worlds.indoor import PARTITION, OfficeConfig, office_spec
from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.systems.collision.shapes import AnalyticDistanceField
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

EMPTY = OfficeConfig(items=0)


def plan(spec: WorldSpec, z: float, step: float = 0.05) -> np.ndarray:
    """Distances (nx, ny) [m] on a level plane to everything but signs."""
    shapes = [solid.shape for solid in spec.solids if solid.material != "signage"]
    field = AnalyticDistanceField(shapes, spec.lower_W, spec.upper_W)
    x, y = (
        np.arange(low + step / 2, high, step)
        for low, high in zip(spec.lower_W[:2], spec.upper_W[:2], strict=True)
    )
    p = np.stack(np.meshgrid(x, y, [z], indexing="ij"), axis=-1)
    return field.distance(p.reshape(-1, 3)).reshape(len(x), len(y))


@pytest.mark.parametrize("seed", range(3))
def test_every_room_has_a_door_that_the_vehicle_passes(seed):
    spec = office_spec(EMPTY, seed)
    free = plan(spec, 1.2) > VEHICLE_RADIUS
    assert np.asarray(label(free)[0]).max() == 1 and free.mean() > 0.4


def test_rooms_and_doors_have_the_configured_sizes():
    config = replace(EMPTY, second_doors=1.0)
    gaps = []
    for seed in range(2):
        walls = plan(office_spec(config, seed), 1.2, 0.02) < 0.0
        for lines in (walls, walls.T):
            for line in lines[:: len(lines) // 80]:
                edges = np.flatnonzero(np.diff(np.concatenate([[1], line, [1]]).astype(int)))
                gaps += [0.02 * (b - a) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    gaps = np.array(gaps)
    doors = gaps[gaps < config.room - PARTITION - 0.1]
    assert doors.min() >= config.door_min - 0.05
    assert np.quantile(doors, 0.9) <= config.door_max + 0.05  # two doors in line look wider
    assert len(gaps) - len(doors) > 60


def test_ends_are_at_both_ends_and_the_way_leads_through_doors():
    detours = []
    for seed in range(4):
        spec = office_spec(OfficeConfig(), seed)
        field, ends = spec.distance_field, np.stack([spec.p_WS, spec.p_WG])
        assert field.distance(ends).min() >= CLEARANCE
        assert ends[1, 0] - ends[0, 0] > 8.0
        detours.append(field.distance(np.linspace(*ends, 200)).min() < VEHICLE_RADIUS)
        assert seed > 0 or connects(field, *ends, VEHICLE_RADIUS, 0.12)
    assert sum(detours) >= 3
