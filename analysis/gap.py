"""`splatpilot gap`: what policies decide by photographs, and by renderings from the same poses.

A policy follows the frames of a capture, with velocities and goals that are drawn, and plans at the
last of them; once by the real images, once by those of the scene that was reconstructed from them.
The same is done in generated worlds of known geometry. Plans are held for a second. The distance
field is fused from the capture's depth; without depth it is the scene's.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import cycle, islice
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.analysis.figures import Panel, write_grid
from splatpilot.diagrams.flight.policies import POLICIES, policy_named
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.scene_folder import read_scene_folder, read_scene_metadata
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.depth_fusion import (
    bounds_of_depth_images,
    esdf_from_depth_images,
)
from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.common.files import claim_folder, locks_folder, write_csv
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import MONTE_CARLO_SEEDS
from splatpilot.systems.common.validation import Config, bounded, require, require_field
from splatpilot.systems.policies.base import Policy, observation
from splatpilot.systems.policies.hypotheses import (
    NUM_WAYPOINTS,
    WAYPOINT_PERIOD,
    Hypotheses,
    num_hypotheses_in,
)
from splatpilot.systems.policies.velocity import RESPONSE_TIME, tracking_acceleration
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.splat_camera import color_pixels, ranged_depth
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.captures.capture import (
    Capture,
    Lens,
    resampling_maps,
    shrink,
    shrink_factor,
)
from splatpilot.training.captures.capture_registry import read_scene_capture
from splatpilot.training.corpus.library import scenario_world

KINDS = "real", "rendered", "generated"
"""Kinds of images."""
_TIMES = WAYPOINT_PERIOD * np.arange(1, NUM_WAYPOINTS + 1)[:, None]  # (10, 1) [s] of plans
_MAX_STEP, _MAX_TURN = 0.5, np.deg2rad(30)  # between frames that follow each other
_FREE, _TRIES = 0.5, 1000  # [m] minimum clearance of cameras in generated worlds; draws of each
_IMAGE_RATE = 15.0  # [Hz] of cameras in generated worlds
_FUSED = 150  # maximum number of depth images that are fused
_RANGE = 8.0  # [m] of fused depth
_RESAMPLES = 2000  # of the bootstrap
_SHOWN = 4  # rows of the picture


@dataclass(kw_only=True)
class GapConfig(Config):
    """Policies, and the states in which they decide."""

    policies: list[str] = field(
        default_factory=lambda: ["distilled_rgb", "diffaero_rgb", "student_rgb", "diffaero"]
    )
    """Names or files of weights of policies with a camera."""
    speed: float = bounded(2.0, "[0.1, 10] m/s")
    """[m/s], nominal, and the maximum of drawn velocities."""
    viewpoints: int = bounded(40, "[2, inf)")
    """[-] Number of viewpoints along a capture, and in generated worlds."""
    draws: int = bounded(4, "[1, inf)")
    """[-] Number of velocities and goals at each viewpoint."""
    frames: int = bounded(8, "[1, inf)")
    """[-] Maximum number of successive images before a plan, for policies with a memory."""
    goal_distance: float = bounded(6.0, "(0, inf) m")
    """[m], of goals from the camera."""
    turn: float = bounded(45.0, "[0, 180] deg")
    """[deg], maximum angle of goals, and half of it of velocities, from the view's middle."""
    generated: list[str] = field(default_factory=lambda: ["P04", "P05"])
    """Scenarios of generated worlds."""
    voxel_size: float = bounded(0.05, "[0.02, 0.5] m")
    """[m], of the distance field that is fused from depth."""
    seed: int = 0
    """Seed of viewpoints, velocities and goals."""

    def check(self) -> None:
        require_field(self, "policies", self.policies, "one policy or more")
        last = len(MONTE_CARLO_SEEDS) // self.viewpoints - 1
        require_field(self, "seed", 0 <= self.seed <= last, f"in [0, {last}]")


class View(NamedTuple):
    """Images of a policy's camera."""

    color: NDArray[np.uint8]  # (H, W, 3)
    depth: NDArray[np.float32]  # (H, W) [m], as of Drake's cameras


class Viewpoint(NamedTuple):
    """Successive poses of the camera, the frames there, and the surfaces."""

    name: str
    X_WCs: list[RigidTransform]
    frames: list[int]  # of the capture; empty in a generated world
    world: World
    field: DistanceField


class Row(NamedTuple):
    """One plan."""

    scene: str
    policy: str
    images: str  # one of KINDS
    viewpoint: str
    draw: int
    seen: float  # [-] fraction of the last image that the capture shows
    clearance: float  # [m] minimum along the plan
    progress: float  # [m] toward the goal
    x: float  # [m] end of the plan in W
    y: float
    z: float


@locks_folder("out")
def run(
    scenes: Sequence[Path], out: Path, config: GapConfig, overwrite: bool = False
) -> dict[str, Any]:
    """Compares plans in scene folders, and writes `gap.csv`, with a row for each plan, `gap.yaml`
    and `views.png` into `out`; returns and prints the table."""
    config.validate()
    names = [scene.resolve().name for scene in scenes]
    unique = len(set(names)) == len(names)
    require(unique, "names of scenes", "different", ", ".join(names), "rename one folder")
    claim_folder(out / "gap.yaml", config, overwrite)
    policies = {name: _policy(name, config.speed) for name in config.policies}
    rows: list[Row] = []
    panels: dict[str, list[Panel | None]] = {}
    for name, scene in zip(names, scenes, strict=True):
        capture = read_scene_capture(scene, read_scene_metadata(scene))
        world = read_scene_folder(scene)
        viewpoints = captured_viewpoints(capture, world, config)
        rows += _plans(name, viewpoints, policies, config, capture)
        panels |= _shown(name, viewpoints, next(iter(policies.values())), capture)
    viewpoints = list(generated_viewpoints(config))
    rows += _plans("generated", viewpoints, policies, config, None)
    write_csv(out / "gap.csv", (row._asdict() for row in rows))
    titles = [f"{kind} image" for kind in KINDS[:2]]
    write_grid(out / "views.png", list(panels.values()), titles, list(panels))
    table = summarize(rows)
    print(format_table(table))
    return table


def _policy(name: str, speed: float) -> Policy:
    """Makes a policy that sees a color or a depth image."""
    config = policy_named(name, speed)
    build: Any = POLICIES.entry_for(config).build
    policy = build(config, None, Scenario()) if hasattr(config, "camera") else None
    known = isinstance(policy, Policy) and policy.image in ("color_image", "depth_image_32f")
    require(known, "policies", "policies with the color or depth of a camera", repr(name))
    assert isinstance(policy, Policy)  # for type checkers
    return policy


def captured_viewpoints(capture: Capture, world: World, config: GapConfig) -> list[Viewpoint]:
    """Returns viewpoints along a capture, evenly spaced over the frames at which a vehicle would
    be free, with the frames that precede each."""
    depth_field = _fused(capture, config.voxel_size) if capture.has_depth else world.distance_field
    p_WCs = np.array([X_WC.translation() for X_WC in capture.X_WCs])
    free = np.flatnonzero(~(depth_field.distance(p_WCs) <= VEHICLE_RADIUS))
    require(len(free), capture.name, f"with a frame {VEHICLE_RADIUS} m from surfaces", "none")
    print(f"{capture.name}: a vehicle would be free at {len(free)} of {len(capture)} frames")
    chosen = np.linspace(0, len(free) - 1, config.viewpoints).round().astype(int)
    viewpoints = []
    for last in free[np.unique(chosen)]:
        frames = [int(last)]
        while len(frames) < config.frames and frames[0] > 0:
            X = capture.X_WCs[frames[0] - 1].InvertAndCompose(capture.X_WCs[frames[0]])
            turn = X.rotation().ToAngleAxis().angle()
            if np.linalg.norm(X.translation()) > _MAX_STEP or turn > _MAX_TURN:
                break
            frames.insert(0, frames[0] - 1)
        X_WCs = [capture.X_WCs[i] for i in frames]
        viewpoints.append(Viewpoint(f"frame {last}", X_WCs, frames, world, depth_field))
    return viewpoints


def _fused(capture: Capture, voxel_size: float) -> DistanceField:
    """Fuses the depth of a capture; space that no frame saw has no surfaces."""
    indices = np.unique(np.linspace(0, len(capture) - 1, _FUSED).round()).astype(int).tolist()
    X_WCs = [capture.X_WCs[i] for i in indices]

    def depths() -> Iterator[NDArray[np.float32]]:
        return (capture.registered_depth(i) for i in indices)

    bounds = bounds_of_depth_images(depths(), capture.K, X_WCs, _RANGE)
    return esdf_from_depth_images(depths(), capture.K, X_WCs, *bounds, voxel_size, _RANGE)


def generated_viewpoints(config: GapConfig) -> Iterator[Viewpoint]:
    """Yields viewpoints in free space of generated worlds, with level cameras that move ahead."""
    step = 0.5 * config.speed / _IMAGE_RATE  # [m] between images
    kinds = list(islice(cycle(config.generated), config.viewpoints))
    for i, kind in enumerate(Progress(kinds, "making worlds")):
        seed = MONTE_CARLO_SEEDS[config.seed * config.viewpoints + i]
        world, rng = make_world(scenario_world(kind), seed), np.random.default_rng([seed, 1])
        lower, upper = world.esdf.lower_W, world.esdf.upper_W
        back = step * np.arange(config.frames - 1, -1, -1)[:, None]
        p_WC, yaws = rng.uniform(lower, upper, (_TRIES, 1, 3)), rng.uniform(-np.pi, np.pi, _TRIES)
        ahead = np.stack([np.cos(yaws), np.sin(yaws), np.zeros(_TRIES)], axis=-1)
        paths = p_WC - back * ahead[:, None]
        free = world.distance_field.distance(paths).min(axis=1) > _FREE
        require(free.any(), kind, f"a world with {_FREE:g} m of clearance", "none", "leave it out")
        path, yaw = paths[free.argmax()], float(yaws[free.argmax()])
        R_WC = RollPitchYaw(-np.pi / 2, 0.0, yaw - np.pi / 2).ToRotationMatrix()
        X_WCs = [RigidTransform(R_WC, p) for p in path]
        yield Viewpoint(f"{kind} {seed}", X_WCs, [], world, world.distance_field)


def _plans(
    scene: str,
    viewpoints: Sequence[Viewpoint],
    policies: dict[str, Policy],
    config: GapConfig,
    capture: Capture | None,
) -> list[Row]:
    rows = []
    progress = Progress(viewpoints, f"planning in {scene}", unit="viewpoint")
    for number, viewpoint in enumerate(progress):
        rng = np.random.default_rng([config.seed, number])
        draws = [_draw(rng, viewpoint.X_WCs[-1], config) for _ in range(config.draws)]
        images: dict[tuple[Any, ...], dict[str, tuple[list[View], float]]] = {}
        for name, policy in policies.items():
            camera = policy.config.camera
            key = camera.width, camera.height, camera.focal_x, camera.max_depth
            if key not in images:
                images[key] = _images(viewpoint, camera, capture)
            X_WBs = [X_WC @ camera.mount().inverse() for X_WC in viewpoint.X_WCs]
            for kind, (views, seen) in images[key].items():
                for draw, (v_WB, p_WG) in enumerate(draws):
                    path = plan(policy, X_WBs, views, v_WB, p_WG)
                    # Outside the field, where distance is NaN, nothing is known to be hit.
                    nearest = np.nanmin(viewpoint.field.distance(path), initial=np.inf)
                    ends = X_WBs[-1].translation(), path[-1]
                    before, after = (np.linalg.norm(p_WG - p_WB) for p_WB in ends)
                    measured = float(nearest) - VEHICLE_RADIUS, float(before - after)
                    where = scene, name, kind, viewpoint.name, draw, seen
                    rows.append(Row(*where, *measured, *map(float, path[-1])))
    return rows


def _draw(
    rng: np.random.Generator, X_WC: RigidTransform, config: GapConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draws a level velocity v_WB [m/s] and a goal p_WG [m] at the height of the camera."""
    ahead = X_WC.rotation().matrix()[:, 2]
    heading = np.arctan2(ahead[1], ahead[0])
    angles = heading + np.deg2rad(config.turn) * rng.uniform(-1.0, 1.0, 2) * [0.5, 1.0]
    velocity, goal = (np.array([np.cos(a), np.sin(a), 0.0]) for a in angles)
    speed = config.speed * rng.uniform(0.25, 1.0)
    return speed * velocity, X_WC.translation() + config.goal_distance * goal


def _images(
    viewpoint: Viewpoint, camera: OnboardCamera, capture: Capture | None
) -> dict[str, tuple[list[View], float]]:
    """Returns the images of a viewpoint by their kind, and the fraction of the last one that is
    real; the rest of a real image is rendered."""
    K, size = camera.camera_info().intrinsic_matrix(), (camera.width, camera.height)
    limits = camera.min_depth, camera.max_depth
    rendered, real, seen = [], [], 0.0
    for k, X_WC in enumerate(viewpoint.X_WCs):
        world = viewpoint.world
        view = world.baked.render(K, *size, X_WC, background=world.background)
        drawn = View(color_pixels(view.color), ranged_depth(view.depth, *limits))
        rendered.append(drawn)
        if capture is not None:
            color, depth, valid = _photograph(capture, viewpoint.frames[k], K, *size)
            depth = np.where(depth > 0.0, ranged_depth(depth, *limits), drawn.depth)
            color = np.where(valid[..., None], color, _exposed(drawn.color, color, valid))
            real.append(View(color, np.where(valid, depth, drawn.depth)))
            seen = float(valid.mean())
    if capture is None:
        return {"generated": (rendered, 1.0)}
    return {"real": (real, seen), "rendered": (rendered, seen)}


def _exposed(
    rendered: NDArray[np.uint8], real: NDArray[np.uint8], valid: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Fits a rendering by a gain to the valid pixels of the real image, so that no edge remains."""
    a, b = rendered[valid].astype(float), real[valid].astype(float)
    gain = float((a * b).sum() / max((a * a).sum(), 1.0)) if valid.any() else 1.0
    return color_pixels(rendered * (gain / 255.0))


def _photograph(
    capture: Capture, i: int, K: NDArray, width: int, height: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]:
    """Resamples a frame: color (H, W, 3), depth (H, W) [m], 0 unknown, and mask of shown pixels."""
    desired = round(capture.width * K[0, 0] / capture.K[0, 0])
    frame = shrink(capture.frame(i), shrink_factor(capture.width, desired))
    h, w = frame.depth.shape
    maps = resampling_maps(Lens(frame.K, w, h), Lens(K, width, height))
    if maps is None:
        return frame.image, frame.depth, frame.valid
    color: Any = cv2.remap(frame.image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    depth: Any = cv2.remap(frame.depth, *maps, cv2.INTER_NEAREST)
    shown = frame.valid.astype(np.uint8)
    return color, depth, cv2.remap(shown, *maps, cv2.INTER_NEAREST).astype(bool)


def plan(
    policy: Policy,
    X_WBs: Sequence[RigidTransform],
    views: Sequence[View],
    v_WB: NDArray[np.float64],
    p_WG: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Returns the positions (10, 3) [m] of the last plan, 0.1 to 1 s after the last image.

    Accelerations, and those by which velocities are tracked, are held for the response time of
    `VelocityTracker`; after it the velocity is constant.
    """
    context = policy.CreateDefaultContext()
    state = context.get_discrete_state()
    values: Sequence[np.ndarray] = [np.array(state.value(i)) for i in range(state.num_groups())]
    is_depth = policy.image == "depth_image_32f"
    for k, (X_WB, view) in enumerate(zip(X_WBs, views, strict=True)):
        q_WB = X_WB.rotation().ToQuaternion().wxyz()
        x = np.concatenate([X_WB.translation(), v_WB, q_WB, np.zeros(3)])
        image = view.depth if is_depth else view.color
        values = policy.decide(observation(k / policy.config.rate, x, p_WG, image), *values)
    decided = {name: values[int(group)] for name, group in policy.state_outputs.items()}
    if "hypotheses" in decided:
        vector = decided["hypotheses"]
        made = Hypotheses.from_vector(vector, num_hypotheses_in(len(vector)))
        assert made is not None
        return made.waypoints_W[made.best]
    p_WB = X_WBs[-1].translation()
    a_WB = decided.get("acceleration")
    if a_WB is None:
        a_WB = tracking_acceleration(v_WB, decided["velocity"])
    held = np.minimum(_TIMES, RESPONSE_TIME)
    return p_WB + v_WB * _TIMES + a_WB * held * (_TIMES - 0.5 * held)


def summarize(rows: Sequence[Row]) -> dict[str, Any]:
    """Returns, by scene and policy, the fraction of plans without a collision by each kind of
    images; that by real ones less that by rendered ones, with the 95 % interval of a bootstrap over
    viewpoints; and the mean distance [m] between the ends of both plans."""
    groups: dict[tuple[str, str], dict[str, list[Row]]] = {}
    for row in rows:
        groups.setdefault((row.scene, row.policy), {}).setdefault(row.images, []).append(row)
    table: dict[str, Any] = {}
    for (scene, policy), kinds in groups.items():
        table.setdefault(scene, {})[policy] = _compare(kinds)
    return table


def _compare(kinds: dict[str, list[Row]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for kind, rows in kinds.items():
        found[kind] = float(np.mean([row.clearance > 0.0 for row in rows]))
        found[f"{kind}_progress"] = float(np.mean([row.progress for row in rows]))
    if "real" in kinds:
        by_viewpoint: dict[str, list[float]] = {}
        apart = []
        for real, rendered in zip(kinds["real"], kinds["rendered"], strict=True):
            gap = float(real.clearance > 0.0) - float(rendered.clearance > 0.0)
            by_viewpoint.setdefault(real.viewpoint, []).append(gap)
            apart.append(np.linalg.norm(np.subtract(real[-3:], rendered[-3:])))
        gaps = np.array([np.mean(values) for values in by_viewpoint.values()])
        drawn = np.random.default_rng(0).integers(len(gaps), size=(_RESAMPLES, len(gaps)))
        found["gap"] = float(gaps.mean())
        found["gap_interval"] = np.quantile(gaps[drawn].mean(axis=1), [0.025, 0.975]).tolist()
        found["plans_apart"] = float(np.mean(apart))
        found["seen"] = float(np.mean([row.seen for row in kinds["real"]]))
    return found


def format_table(table: dict[str, Any]) -> str:
    """Returns the table of `summarize` as text."""
    titles = f"{'real':>6} {'rendered':>9} {'gap [points]':>22} {'apart':>8}"
    lines = [f"{'scene':<20} {'policy':<16} {titles}"]
    for scene, policies in table.items():
        for policy, found in policies.items():
            if "gap" not in found:
                lines.append(f"{scene:<20} {policy:<16} {found['generated']:>6.0%}")
                continue
            low, high = (100.0 * limit for limit in found["gap_interval"])
            gap = f"{100.0 * found['gap']:+.1f} ({low:+.1f} to {high:+.1f})"
            apart = f"{found['plans_apart']:.2f} m"
            shares = f"{found['real']:>6.0%} {found['rendered']:>9.0%}"
            lines.append(f"{scene:<20} {policy:<16} {shares} {gap:>22} {apart:>8}")
    return "\n".join(lines)


def _shown(
    scene: str, viewpoints: Sequence[Viewpoint], policy: Policy, capture: Capture
) -> dict[str, list[Panel | None]]:
    rows: dict[str, list[Panel | None]] = {}
    for viewpoint in viewpoints[:: max(1, len(viewpoints) // _SHOWN)][:_SHOWN]:
        last = viewpoint._replace(X_WCs=viewpoint.X_WCs[-1:], frames=viewpoint.frames[-1:])
        images = _images(last, policy.config.camera, capture)
        panels = [Panel(images[kind][0][-1].color / 255.0) for kind in KINDS[:2]]
        rows[f"{scene}\n{viewpoint.name}"] = [*panels]
    return rows
