"""Reconstructed scenes with inserted obstacles."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.ndimage import label

from splatpilot.diagrams.worlds.building_blocks import (
    TIGHT_CLEARING,
    draw_paint,
    has_clearance,
    require_order,
)
from splatpilot.diagrams.worlds.feasibility import TRIES
from splatpilot.diagrams.worlds.scene_folder import SceneSource, draw_ends, read_scene_world
from splatpilot.diagrams.worlds.solids.solid import Solid, WorldSpec, cut_faces, draw
from splatpilot.diagrams.worlds.solids.textures import Lamplight
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Capsule, Shape, Sphere
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import bounded
from splatpilot.systems.splats.scene import concatenated
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

GAP = 1.3 * 2 * VEHICLE_RADIUS  # [m], minimum width of gaps

_MATERIALS = ["hazard", "crate", "metal", "foliage", "brick", "wood"]


@dataclass
class InsertedConfig(SceneSource):
    """A scene on disk with 3 to 5 solids in its free space."""

    least: int = bounded(3, "[1, 100]")  # [-] minimum number of solids
    most: int = bounded(5, "[1, 100]")  # [-] maximum number of solids
    half_min: float = bounded(0.10, "(0, 100] m")  # [m] smallest half width of a solid
    half_max: float = bounded(0.25, "(0, 100] m")  # [m] largest half width of a solid
    # [m] Minimum width of every gap on the route, and between two solids.
    gap: float = bounded(GAP, f"[{2 * VEHICLE_RADIUS:.3f}, 10] m")

    def check(self) -> None:
        super().check()
        require_order(self, "half_min", "half_max")
        require_order(self, "least", "most")


def inserted_world(config: InsertedConfig, seed: int) -> World:
    """Reads the scene and inserts solids drawn from the seed near the line from start to goal. Any
    two are at least `gap` apart, start and goal keep 0.9 m, and a route remains that is `gap` wide
    everywhere."""
    scene = read_scene_world(config, seed)
    for attempt in range(TRIES):
        rng = np.random.default_rng([seed, attempt])
        if config.draw_ends and attempt % 10 == 9:
            scene = draw_ends(config, scene, int(rng.integers(2**31)))
        solids = _draw_solids(config, scene, rng)
        if len(solids) < config.least:
            continue
        esdf = _merge(scene.esdf, solids)
        if _leaves_route(esdf, scene.p_WS, scene.p_WG, config.gap):
            break
    else:
        raise InfeasibleFlightError(
            f"{config.path}: none of {TRIES} draws of {config.least} to {config.most} solids "
            f"leaves a route of {config.gap:.2f} m width from start to goal; use a smaller gap or "
            "fewer solids"
        )
    # Lit from above.
    middle = (scene.p_WS + scene.p_WG) / 2
    lamps = np.stack([scene.p_WS, middle, scene.p_WG]) + np.array([0, 0, 1.5])
    light = Lamplight(lamps, np.ones(3), esdf)
    name, ends = f"{scene.name}_inserted", (scene.p_WS, scene.p_WG)
    box = esdf.lower_W, esdf.upper_W
    spec = WorldSpec(name, *box, solids, *ends, light=lambda _: light, seed=seed)
    parts = draw(spec, solids, light), scene.gaussians  # the frontier stays last
    gaussians = replace(scene.gaussians, **concatenated(parts))
    observations = scene.observations
    if observations is not None:
        spacing = observations.voxel_size
        surfaces = np.concatenate([_surface(solid.shape, spacing) for solid in solids])
        observations = observations.with_surfaces(surfaces)
    field = {"esdf": esdf, "distance_field": esdf}
    return replace(scene, name=name, gaussians=gaussians, observations=observations, **field)


def _draw_solids(config: InsertedConfig, world: World, rng: np.random.Generator) -> list[Solid]:
    """Draws solids that keep their distances from start, goal and each other."""
    number = int(rng.integers(config.least, config.most + 1))
    route = world.p_WG - world.p_WS
    solids: list[Solid] = []
    for _ in range(40 * number):
        if len(solids) == number:
            break
        p = world.p_WS + rng.uniform(0.15, 0.85) * route + rng.uniform(-0.8, 0.8, 3)
        sample = world.esdf.query(p)
        if sample.state != FieldState.FREE or sample.distance < config.half_min:
            continue
        shape = _shape(config, p, rng)
        if not has_clearance(shape, [world.p_WS, world.p_WG], TIGHT_CLEARING):
            continue
        surface = _surface(shape)
        if not all(has_clearance(other.shape, surface, config.gap) for other in solids):
            continue
        solids.append(Solid(shape, *draw_paint(_MATERIALS, rng)))
    return solids


def _shape(config: InsertedConfig, p: NDArray, rng: np.random.Generator) -> Shape:
    half = rng.uniform(config.half_min, config.half_max, 3)
    kind = rng.integers(3)
    if kind == 0:
        return Sphere(p, float(half[0]))
    if kind == 1:
        return Box(RigidTransform(RollPitchYaw(*rng.uniform(-0.3, 0.3, 3)), p), 2 * half)
    up = np.array([0.0, 0.0, rng.uniform(0.2, 0.6)])
    return Capsule(p - up, p + up, float(half.min()))


def _surface(shape: Shape, spacing: float = math.inf) -> NDArray:
    """Samples points (N, 3) on a shape, 9 x 9 on a face, or more at most `spacing` [m] apart."""
    points, zero = [], np.zeros(3)
    for face in cut_faces(shape, zero, zero):
        counts = [max(9, math.ceil(length / spacing) + 1) for length in face.size]
        s = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in counts)), axis=-1).reshape(-1, 2)
        points.append(face.at(s * face.size)[0])
    return np.concatenate(points)


def _merge(esdf: Esdf, solids: list[Solid]) -> Esdf:
    """Returns the union of a scene and solids, which are known space."""
    field = AnalyticDistanceField(
        [solid.shape for solid in solids], esdf.lower_W, esdf.upper_W + esdf.voxel_size
    )
    centers = np.stack(np.meshgrid(*esdf.voxel_centers(), indexing="ij"), axis=-1)
    distances, states = esdf.distances.copy(), esdf.states.copy()
    for i in range(len(distances)):
        nearest = field.distance(centers[i])
        distances[i] = np.minimum(distances[i], nearest)
        states[i][nearest < 0] = FieldState.OCCUPIED
    return Esdf(distances, states, esdf.lower_W, esdf.voxel_size)


def _leaves_route(esdf: Esdf, p_WS: NDArray, p_WG: NDArray, gap: float) -> bool:
    """Checks that a route `gap` [m] wide through known free space joins start and goal."""
    free = esdf.conservative().distances > gap / 2
    part = np.asarray(label(free)[0])  # pyright: ignore[reportIndexIssue]
    parts = []
    for p in (p_WS, p_WG):
        # The route starts within a radius of the ends, which may be narrower.
        cell = ((p - esdf.lower_W) / esdf.voxel_size).astype(int)
        reach = int(VEHICLE_RADIUS / esdf.voxel_size)
        box = tuple(slice(max(c - reach, 0), c + reach + 1) for c in cell)
        parts.append(set(np.unique(part[box])) - {0})
    return bool(parts[0] & parts[1])
