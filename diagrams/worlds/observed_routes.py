"""Starts and goals whose views along the route the capture observed."""

import functools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from splatpilot.diagrams.worlds.feasibility import CLEARANCE, LONG_ENOUGH, SHORTEST, longest_part
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.observations import HEADINGS
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.scene import color_to_sh

MAX_UNOBSERVED = 0.02  # mean fraction of the pixels along a route
_CAMERA = OnboardCamera(width=32, height=24)  # 90 x 74 degrees, the widest view of the policies
_MAX_POINTS, _MIN_SPACING = 300, 0.45  # of a table of views; [m] between its points
_LONGEST = 40.0  # [m] of a route
_STEP = 0.5  # [m] between checked poses of a route
_STARTS, _GOALS = 24, 6  # tried in a draw; goals for each start


class ObservedViews:
    """Measures the fraction of a view that shows the frontier, nothing unless the capture saw the
    sky, or a surface that no image saw from a similar direction, by the world's `observations`."""

    def __init__(self, world: World, camera: OnboardCamera = _CAMERA) -> None:
        count = len(world.gaussians)
        sh = np.full((count, 1, 3), color_to_sh(0.0), np.float32)
        sh[count - world.num_frontier :] = color_to_sh(1.0)
        self._scene = world.baked.recolored(sh)
        self._observations = world.observations
        self._has_sky = isinstance(world.background, EnvironmentMap)
        camera = replace(camera, width=_CAMERA.width, height=_CAMERA.height, distortion=None)
        self._K, self._X_BC = camera.camera_info().intrinsic_matrix(), camera.mount()
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(self._K).T
        self._rays_C = rays  # (H, W, 3), z = 1

    def unobserved(self, X_WB: RigidTransform) -> float:
        """Returns the fraction for a vehicle at X_WB."""
        X_WC = X_WB @ self._X_BC
        height, width, _ = self._rays_C.shape
        view = self._scene.render(self._K, width, height, X_WC)
        empty = view.alpha < 0.5
        hidden = ~empty & (view.color[..., 0] > 0.5 * view.alpha)
        surface = ~empty & ~hidden & (view.depth > 0.0) & np.isfinite(view.depth)
        count = np.count_nonzero(hidden) + (0 if self._has_sky else np.count_nonzero(empty))
        if self._observations is not None:
            p_CQ = self._rays_C[surface] * view.depth[surface][:, None]
            p_WQ = p_CQ @ X_WC.rotation().matrix().T + X_WC.translation()
            count += np.count_nonzero(~self._observations.agree_with(p_WQ, X_WC.translation()))
        return count / empty.size

    def ahead(self, p_WB: ArrayLike, yaw: float) -> float:
        """Returns the fraction for a level vehicle at p_WB (3,) [m] with a heading [rad]."""
        return self.unobserved(RigidTransform(RollPitchYaw(0.0, 0.0, yaw), np.asarray(p_WB)))

    def along(self, route: NDArray[np.float64]) -> float:
        """Returns the mean fraction along a route (N, 3) [m], with the heading ahead."""
        lengths = np.linalg.norm(np.diff(route, axis=0), axis=1)
        at = np.concatenate([[0.0], np.cumsum(lengths)])  # [m]
        s = np.linspace(0.0, at[-1], max(int(np.ceil(at[-1] / _STEP)), 1) + 1)

        def position(s: NDArray) -> NDArray[np.float64]:
            return np.stack([np.interp(s, at, x) for x in route.T], axis=-1)

        # The last pose keeps the heading of its approach.
        step = position(np.minimum(s + _STEP, at[-1])) - position(np.minimum(s, at[-1] - _STEP))
        yaws = np.arctan2(step[:, 1], step[:, 0])
        return float(np.mean([*map(self.ahead, position(s), yaws)]))


def with_views(world: World) -> World:
    """Returns a world whose observations have a table of views in its flyable space; raises
    InfeasibleFlightError without such space."""
    if world.observations is None:
        return world
    points, spacing = longest_part(world.esdf).p_WN, _MIN_SPACING
    while True:
        cells = np.round(points / spacing).astype(int)
        first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
        if len(first) <= _MAX_POINTS:
            break
        spacing *= 1.2
    views, yaws = ObservedViews(world), 2.0 * np.pi * np.arange(HEADINGS) / HEADINGS
    shown = Progress(points[first], "rendering views of routes", unit="position", delay=2.0)
    table = np.array([[views.ahead(p, yaw) for yaw in yaws] for p in shown])
    observations = replace(world.observations, view_points=points[first], unobserved=table)
    return replace(world, observations=observations)


@dataclass(frozen=True)
class ObservedRoute:
    """A start, a goal, and the shortest route between them."""

    p_WS: NDArray[np.float64]  # (3,) [m]
    p_WG: NDArray[np.float64]  # (3,) [m]
    length: float  # [m]
    unobserved: float  # mean fraction of a camera's pixels along it


def choose_observed_route(
    world: World,
    limit: float = MAX_UNOBSERVED,
    min_length: float = SHORTEST,
    seed: int | None = None,
) -> ObservedRoute:
    """Chooses a shortest route through known free space, at least `min_length` [m] long, with a
    mean fraction of unobserved pixels up to `limit`; nearly the longest, or drawn from a seed."""
    search, longest = _search(world, limit, min_length)
    if longest is None:
        raise InfeasibleFlightError(
            f"unobserved pixels along a route of at least {min_length:g} m in {world.name} "
            f"must be at most {limit:.0%} of a camera's, on average, got no such route; the best "
            f"single view has {search.table.min(initial=1.0):.0%}: capture more of the scene, or "
            "raise max_unobserved"
        )
    if seed is None:
        return longest
    return search.draw(limit, 0.6 * longest.length, np.random.default_rng(seed)) or longest


def choose_default_route(world: World) -> ObservedRoute:
    """Chooses nearly the longest observed route or, if that is shorter than `LONG_ENOUGH`, a long
    one with nearly the smallest unobserved fraction. The world needs a table of views.

    Raises:
        InfeasibleFlightError: if there is no route of `SHORTEST`.
    """
    search = _Search(world, SHORTEST)
    observed = search.longest(MAX_UNOBSERVED)
    if observed is None or observed.length < LONG_ENOUGH:
        return search.best(observed)
    return observed


@functools.lru_cache(maxsize=1)
def _search(
    world: World, limit: float, min_length: float
) -> tuple["_Search", ObservedRoute | None]:
    """Returns what does not depend on the seed: the search, and its longest route."""
    search = _Search(world, min_length)
    return search, search.longest(limit)


class _Search:
    """Shortest routes of free space, and the fraction of unobserved pixels along them."""

    def __init__(self, world: World, min_length: float) -> None:
        self._min_length = min_length
        self.part = longest_part(world.esdf, min_length=min_length)
        observations = world.observations
        assert observations is not None and len(observations.view_points)
        self._views = ObservedViews(world)
        clearance = world.esdf.distance(self.part.p_WN)
        # Ends keep off surfaces, or a flight would end with a view of one.
        typical = float(np.median(clearance[self.part.nodes]))
        self.open = clearance >= min(CLEARANCE, typical)
        self.table = observations.unobserved
        points = KDTree(observations.view_points)
        self.row = np.asarray(points.query(self.part.p_WN)[1])  # of the table, for each node

    def longest(self, limit: float) -> ObservedRoute | None:
        """Returns nearly the longest route within the limit."""
        best = None
        for start in self._starts(limit, np.random.default_rng(0)):
            tree = _Tree(self, start)
            shortest = self._min_length if best is None else np.nextafter(best.length, np.inf)
            goals = np.flatnonzero((tree.goals >= shortest) & (tree.unobserved <= limit))
            goals = goals[np.argsort(-tree.lengths[goals], kind="stable")]
            best = self._first(tree, goals[:: max(len(goals) // _GOALS, 1)], limit) or best
        return best

    def draw(self, limit: float, desired: float, rng: np.random.Generator) -> ObservedRoute | None:
        """Draws a route of at least the desired length [m] within the limit."""
        for start in self._starts(limit, rng):
            tree = _Tree(self, start)
            longer = tree.goals >= max(desired, self._min_length)
            goals = rng.permutation(np.flatnonzero(longer & (tree.unobserved <= limit)))
            if route := self._first(tree, goals[:_GOALS], limit):
                return route
        return None

    def best(self, otherwise: ObservedRoute | None) -> ObservedRoute:
        """Returns a long route with nearly the smallest unobserved fraction."""
        routes, enough = [], min(LONG_ENOUGH, 0.8 * self.part.length)
        for start in np.random.default_rng(0).permutation(self.part.nodes)[: 4 * _STARTS]:
            tree = _Tree(self, int(start))
            fractions = np.where(tree.lengths >= enough, tree.unobserved, np.inf)
            if np.isfinite(fractions).any():
                routes.append(self._route(tree, int(np.argmin(fractions))))
        if best := min(routes, key=lambda route: route.unobserved, default=otherwise):
            return best
        tree = _Tree(self, self.part.end)
        return self._route(tree, int(np.argmax(tree.lengths)))

    def _starts(self, limit: float, rng: np.random.Generator) -> NDArray[np.intp]:
        """Draws nodes of the part with an observed view."""
        nodes = self.part.nodes[self.open[self.part.nodes]]
        best = self.table[self.row[nodes]].min(axis=1)
        return rng.permutation(nodes[best <= 2.0 * limit])[:_STARTS]

    def _first(self, tree: "_Tree", goals: NDArray[np.intp], limit: float) -> ObservedRoute | None:
        """Returns the first route to one of the goals that is within the limit."""
        routes = (self._route(tree, goal) for goal in goals)
        return next((route for route in routes if route.unobserved <= limit), None)

    def _route(self, tree: "_Tree", goal: int) -> ObservedRoute:
        nodes = [int(goal)]
        while nodes[-1] != tree.start:
            nodes.append(int(tree.before[nodes[-1]]))
        points = self.part.p_WN[nodes[::-1]]
        length = float(tree.lengths[goal])
        return ObservedRoute(points[0], points[-1], length, self._views.along(points))


class _Tree:
    """The shortest routes from a node."""

    def __init__(self, search: _Search, start: int) -> None:
        lengths, before = dijkstra(
            search.part.graph,
            directed=False,
            indices=start,
            limit=_LONGEST,
            return_predecessors=True,
        )
        self.start = start
        self.before = np.where(before < 0, start, before)  # of each node, towards the start
        self.lengths = np.where(np.isfinite(lengths), lengths, -1.0)  # [m]
        self.goals = np.where(search.open, self.lengths, -1.0)  # [m]
        step = search.part.p_WN - search.part.p_WN[self.before]
        heading = np.arctan2(step[:, 1], step[:, 0]) * HEADINGS / (2.0 * np.pi)
        rows, columns = search.row[self.before], np.round(heading).astype(int) % HEADINGS
        level = np.hypot(step[:, 0], step[:, 1]) > 1e-6
        views = np.where(level, search.table[rows, columns], search.table[rows].min(axis=1))
        # Sums along the tree, over twice as many steps in each pass.
        total = views * np.where(self.lengths > 0, self.lengths - self.lengths[self.before], 0.0)
        ancestor = self.before
        while (ancestor != start).any():
            total = total + total[ancestor]
            ancestor = ancestor[ancestor]
        self.unobserved = total / np.maximum(self.lengths, 1e-9)  # approximate mean to each node
