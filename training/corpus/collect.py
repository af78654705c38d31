"""Collects a corpus in any number of worlds in parallel."""

import shutil
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydrake.math import RollPitchYaw

from splatpilot.diagrams.flight.sensors import make_onboard_camera
from splatpilot.diagrams.worlds.appearance import draw_appearance, with_appearance
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.files import claim_folder, locks_folder, require_writable_folder
from splatpilot.systems.common.processes import available_cores, map_processes
from splatpilot.systems.common.progress import Progress, resumable, say
from splatpilot.systems.common.provenance import InfeasibleFlightError, revision
from splatpilot.systems.common.validation import require, validate
from splatpilot.systems.splats.splat_camera import color_pixels, ranged_depth
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state
from splatpilot.training.corpus import library
from splatpilot.training.corpus.corpus import (
    CONFIG,
    EXPERT,
    OFF_PATH,
    RECOVERY,
    SOURCES,
    Corpus,
    CorpusConfig,
    OtherVersionError,
    Samples,
    Shard,
    subfolders,
    write_ledger,
    write_shard,
)
from splatpilot.training.corpus.expert import PLANNER, Label, Labeler, fly_planner, fly_policy


class Demonstration(NamedTuple):
    """A state and the trajectories to imitate there."""

    state: np.ndarray  # (13,)
    waypoints_W: np.ndarray  # (K, 10, 3) [m], cheapest first; NaN for those in contact


def keep_clear(labels: Iterable[Label], field: Esdf) -> list[Demonstration]:
    """Drops trajectories in contact, and states without others."""
    kept = []
    for state, plan in labels:
        waypoints_W = plan.waypoints_W
        clear = (field.distance(waypoints_W) > VEHICLE_RADIUS).all(axis=1)  # (K,)
        if clear.any():
            waypoints_W = np.where(clear[:, None, None], waypoints_W, np.nan)
            kept.append(Demonstration(state, waypoints_W[np.argsort(~clear, kind="stable")]))
    return kept


def render_samples(
    demonstrations: list[Demonstration],
    world: World,
    labeler: Labeler,
    config: CorpusConfig,
    bound: float,
    rng: np.random.Generator,
) -> Samples:
    """Renders demonstrations in a random appearance, displaced copies by at most `bound` [m]."""
    copies = config.perturbation.copies
    samples = Samples.zeros(len(demonstrations) * (1 + copies), config.size)
    if not demonstrations:
        return samples
    appearance = draw_appearance(rng, config.appearance)
    optics = config.camera
    camera = make_onboard_camera(optics, with_appearance(world, appearance))
    row = 0
    for state, waypoints_W in demonstrations:
        p_WB, v_WB, _, _ = QuadrotorState.of(state)
        X_WB = pose_from_state(state)
        reach = min(bound, float(labeler.field.distance(p_WB)) - VEHICLE_RADIUS)
        for copy in range(1 + copies):
            X_WP = library.perturb_pose(X_WB, config.perturbation, reach, rng) if copy else X_WB
            R_PW, p_WP = X_WP.rotation().matrix().T, X_WP.translation()
            view = camera.render(X_WP)
            samples.color[row] = color_pixels(view.color)
            samples.depth[row] = ranged_depth(view.depth, optics.min_depth, optics.max_depth)
            samples.X_WB[row] = *X_WP.rotation().ToQuaternion().wxyz(), *p_WP
            samples.v_B[row] = R_PW @ v_WB
            samples.goal_B[row] = R_PW @ (labeler.toa.p_WG - p_WP)
            samples.trajectories_B[row] = (waypoints_W - p_WP) @ R_PW.T
            row += 1
    return samples


# Of states off the expert's paths: its flights show neither near obstacles straight ahead nor stops
# near the goal.
STATES_PER_APPEARANCE = 60

_CLEARANCE = 0.05  # [m], minimum clearance
_BEFORE = 1.0  # [m], maximum clearance before a surface
_UPRIGHT = 0.5  # [-], minimum horizontal part of its normal
_ARRIVING = 4.0  # [m], maximum distance from the goal of those that are near it
_CANDIDATES = 8  # for each state
_TURN = 0.6  # [rad], standard deviation of the yaw about the path, or about the nearest surface
_LEAN = 0.12  # [rad], standard deviation of roll and pitch
_BRAKING = 3.0  # [m/s^2], which limits speeds by the distance to the nearest surface
_SIDEWAYS = 0.3  # [m/s], standard deviation


def draw_off_path(
    labeler: Labeler, count: int, speed: float, rng: np.random.Generator
) -> np.ndarray:
    """Draws states (count, 13) from which a path leads to the goal: half within a meter of a
    surface, looking at it; a quarter within 4 m of the goal, uniform in distance, looking anywhere;
    the others uniform in space, looking along the path. All deviate from that, and fly where they
    look, at up to `speed` [m/s] and no faster than they can stop."""
    field, toa = labeler.field, labeler.toa
    centers = toa.starts(field, _CLEARANCE)
    candidates = centers[rng.integers(len(centers), size=_CANDIDATES * count)]
    to_goal = np.linalg.norm(centers - toa.p_WG, axis=1)
    share = np.where(to_goal < _ARRIVING, 1.0 / np.maximum(to_goal, field.voxel_size) ** 2, 0.0)
    near = count // 4 if share.any() else 0
    arriving = centers[rng.choice(len(centers), near, p=share / share.sum())] if near else []
    candidates = np.concatenate([np.reshape(arriving, (-1, 3)), candidates])
    nearest = field.query(candidates)
    before = np.linalg.norm(nearest.gradient[:, :2], axis=1) > _UPRIGHT
    before &= nearest.distance < VEHICLE_RADIUS + _BEFORE
    before[:near] = False
    before = np.flatnonzero(before)[: count // 2]
    chosen = np.concatenate([before, np.arange(count - len(before))])
    p_WB, distance = candidates[chosen], nearest.distance[chosen]
    toward = toa.gradient(p_WB)
    toward[: len(before)] = nearest.gradient[before]
    yaw = np.arctan2(-toward[:, 1], -toward[:, 0]) + _TURN * rng.normal(size=count)
    yaw[len(before) : len(before) + near] = rng.uniform(-np.pi, np.pi, near)
    roll, pitch = _LEAN * rng.normal(size=(2, count))
    fastest = np.sqrt(2.0 * _BRAKING * np.maximum(distance - VEHICLE_RADIUS, 0.0))
    ahead = np.minimum(speed, fastest) * rng.random(count)
    aside, up = _SIDEWAYS * rng.normal(size=(2, count))
    cos, sin = np.cos(yaw), np.sin(yaw)
    v_WB = np.stack([cos * ahead - sin * aside, sin * ahead + cos * aside, up], axis=1)
    angles = np.stack([roll, pitch, yaw], axis=1)
    q_WB = np.array([RollPitchYaw(rpy).ToQuaternion().wxyz() for rpy in angles])
    return np.concatenate([p_WB, v_WB, q_WB, np.zeros((count, 3))], axis=1)


_START_CLEARANCE = 0.3  # [m]


def collect_world(folder: Path, config: CorpusConfig, index: int, revision: str) -> None:
    """Collects the world `index` of the library: its record, then its shards."""
    source = library.world_source(config.worlds, config.seed, index)
    world = make_world(source.world, source.seed)
    labeler = Labeler(world.esdf, world.p_WG, config.expert)
    bound = source.perturbation_bound
    library.record_world(folder / "worlds" / source.name, source, world.esdf)

    def write(kind: int, parts: list[Samples], flights: list[dict]) -> None:
        about = {"world": source.name, "source": kind, "flights": flights, "revision": revision}
        write_shard(shard_folder(folder, source.name, kind), parts, config.size, about)

    off_path = []
    own_pose = replace(config, perturbation=replace(config.perturbation, copies=0))
    for first in range(0, config.off_path, STATES_PER_APPEARANCE):
        # The expert's flights use the numbers from 0.
        rng = np.random.default_rng([config.seed, source.seed, config.flights + first])
        count = min(STATES_PER_APPEARANCE, config.off_path - first)
        states = draw_off_path(labeler, count, config.expert.speed, rng)
        shown = keep_clear(labeler.labels(states), labeler.field)
        off_path.append(render_samples(shown, world, labeler, own_pose, bound, rng))

    rngs = [np.random.default_rng([config.seed, source.seed, k]) for k in range(config.flights)]
    min_time = 0.5 * labeler.toa.value(world.p_WS)
    starts = [world.p_WS]
    if config.flights > 1:
        free = labeler.toa.starts(labeler.field, _START_CLEARANCE, min_time)
        starts += [free[rng.integers(len(free))] for rng in rngs[1:]]
    if config.expert.policy == PLANNER:
        flights = fly_planner(np.stack(starts), world, config.expert, labeler)
    else:
        flights = [fly_policy(start, world, config.expert, labeler) for start in starts]
    parts, entries = [], []
    for number, (start, flight, rng) in enumerate(zip(starts, flights, rngs, strict=True)):
        shown = keep_clear(flight.labels if flight.is_demonstration else (), labeler.field)
        parts.append(render_samples(shown, world, labeler, config, bound, rng))
        entries.append(
            {
                "flight": number,
                "seed": source.seed,
                "start": start.tolist(),
                "goal": world.p_WG.tolist(),
                "outcome": str(flight.outcome),
                "time_s": flight.time,
                "least_clearance_m": flight.min_clearance,
                "states": len(shown),
            }
        )
    if config.off_path:
        write(OFF_PATH, off_path, [{"states": sum(map(len, off_path))}])
    write(EXPERT, parts, entries)


def shard_folder(folder: Path, world: str, source: int = EXPERT) -> Path:
    """Returns the folder of a world's samples of a source."""
    return folder / "shards" / f"{SOURCES[source]}-{world}"


@locks_folder("out")
def run(*, config: CorpusConfig, out: Path, worlds: int, jobs: int | None = None) -> Corpus:
    """Collects the first `worlds` worlds of a corpus in `out`, those that are missing or damaged.
    The same call resumes an interrupted run, with bitwise identical results."""
    validate(config)
    jobs = available_cores() if jobs is None else jobs
    require(jobs >= 1, "--jobs", "at least 1", jobs)
    require(worlds >= 1, "--worlds", "at least 1", worlds)
    sources = [library.world_source(config.worlds, config.seed, k) for k in range(worlds)]
    claim_folder(out / CONFIG, config)
    for part in ("worlds", "shards"):
        require_writable_folder(out / part)
    present = [k for k in range(worlds) if shard_folder(out, sources[k].name).exists()]
    checked = Progress(present, "checking worlds", unit="world", leave=False, delay=1.0)
    damage = {k: reason for k in checked if (reason := _damage(out, sources[k], config))}
    missing = sorted(set(range(worlds)) - set(present) | set(damage))
    program = revision()
    if missing:
        _require_same_program(out, program)
    for k in missing:
        name = sources[k].name
        if k in damage:
            say(f"{damage[k]}: {name} is collected again")
        folders = [shard_folder(out, name, source) for source in (OFF_PATH, EXPERT)]
        for path in (out / "worlds" / name, *folders):
            shutil.rmtree(path, ignore_errors=True)
    collect = partial(_collect, out, config, program)
    bar = Progress(total=worlds, initial=worlds - len(missing), desc="collecting", unit="world")

    def kept() -> str:
        return f"{bar.n} of {worlds} worlds are in {out}; the same command resumes there"

    with bar, resumable(kept):
        for reason in map_processes(collect, missing, jobs):
            if reason:
                say(reason)
            bar.update()
    corpus = Corpus(out)
    write_ledger(corpus)
    return corpus


def _damage(out: Path, source: library.WorldSource, config: CorpusConfig) -> str:
    """Describes the damage of a collected world; empty without damage."""
    try:
        record = library.WorldRecord(out / "worlds" / source.name)
        _ = record.esdf
        for kind in (EXPERT, OFF_PATH) if config.off_path else (EXPERT,):
            Shard(shard_folder(out, source.name, kind)).verify()
    except OtherVersionError:
        raise
    except (ValueError, FileNotFoundError) as error:
        return str(error)
    if record.source.world != source.world:
        raise ValueError(
            f"{record.path} is a world of another definition than the configuration gives now: the "
            "file of its kind has changed; restore that, or choose another --out"
        )
    return ""


def _require_same_program(out: Path, program: str) -> None:
    """Raises ValueError if another program collected the samples, except those of recovery."""
    for path in subfolders(out / "shards"):
        try:
            shard = Shard(path)
        except ValueError:  # It is damaged.
            continue
        if shard.source != RECOVERY and shard.revision != program:
            raise ValueError(
                f"revision of {shard.path} must be that of the program, {program}, got "
                f"{shard.revision}; go back to that revision, or collect more worlds with another "
                "seed in another --out"
            )


def _collect(out: Path, config: CorpusConfig, revision: str, index: int) -> str:
    """Collects a world; returns the reason if it is infeasible."""
    try:
        collect_world(out, config, index, revision)
    except InfeasibleFlightError as error:
        return f"world {index} is left out: {error}"
    return ""
