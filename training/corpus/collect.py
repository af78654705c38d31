"""Collects a corpus in any number of worlds in parallel."""

import shutil
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydrake.math import RollPitchYaw

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.flight.sensors import make_camera
from splatpilot.diagrams.worlds.appearance import draw_appearance, with_appearance
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.files import claim_folder, holds_folder, require_writable_folder
from splatpilot.systems.common.processes import available_cores, map_processes
from splatpilot.systems.common.progress import Progress, resumable, say
from splatpilot.systems.common.provenance import InfeasibleFlightError, revision
from splatpilot.systems.common.validation import FieldError, require
from splatpilot.systems.splats.splat_camera import color_pixels, ranged_depth
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state
from splatpilot.training.corpus.corpus import CONFIG, Corpus, CorpusConfig, entries, write_ledger
from splatpilot.training.corpus.expert import (
    PLANNER,
    ExpertFlight,
    Label,
    Labeler,
    fly_planner,
    fly_policy,
)
from splatpilot.training.corpus.library import (
    WorldRecord,
    WorldSource,
    perturbed,
    record_world,
    world_source,
)
from splatpilot.training.corpus.samples import (
    EXPERT,
    OFF_PATH,
    RECOVERY,
    SOURCES,
    OtherVersionError,
    Samples,
    Shard,
    write_shard,
)


class Demonstration(NamedTuple):
    """A state and what to imitate there."""

    state: np.ndarray  # (13,)
    waypoints_W: np.ndarray  # (K, 10, 3) [m], cheapest first; NaN for those that touch something


def keep_clear(labels: Iterable[Label], field: Esdf) -> list[Demonstration]:
    """Drops trajectories that touch something, and states that have no others."""
    kept = []
    for state, plan in labels:
        waypoints_W = plan.waypoints_W
        clear = (field.distance(waypoints_W) > VEHICLE_RADIUS).all(axis=1)  # (K,)
        if clear.any():
            waypoints_W = np.where(clear[:, None, None], waypoints_W, np.nan)
            kept.append(Demonstration(state, waypoints_W[np.argsort(~clear, kind="stable")]))
    return kept


def see_states(
    demonstrations: list[Demonstration],
    world: World,
    labeler: Labeler,
    config: CorpusConfig,
    bound: float,
    rng: np.random.Generator,
) -> Samples:
    """
    Renders demonstrations, each from its own pose and from perturbed ones.

    Args:
        demonstrations: n of them.
        world: where; its look is drawn anew.
        labeler: that of the labels.
        config: of the corpus.
        bound: how far poses may be perturbed in this world [m].
        rng: draws look and perturbations.

    Returns:
        n (1 + copies) samples, `world` and `source` left open.
    """
    copies = config.perturbation.copies
    samples = Samples.zeros(len(demonstrations) * (1 + copies), config.size)
    if not demonstrations:
        return samples
    look = draw_appearance(rng, config.appearance)
    camera, optics = make_camera(config.camera, with_appearance(world, look)), config.camera
    row = 0
    for state, waypoints_W in demonstrations:
        p_WB, v_WB, _, _ = QuadrotorState.of(state)
        X_WB = pose_from_state(state)
        clearance = float(labeler.field.distance(p_WB)) - VEHICLE_RADIUS
        reach = min(bound, clearance)
        around = [perturbed(X_WB, config.perturbation, reach, rng) for _ in range(copies)]
        for X_WP in [X_WB, *around]:
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


# States off the expert's paths: anywhere in free space, half of them before a surface. An expert
# keeps clear of everything, so no image of its flights shows an obstacle near and straight ahead.
# Nor does it stop near its goal; students of its flights alone do, and stay.


STATES_A_LOOK = 60
"""Number of states with the same appearance of the world."""

_CLEARANCE = 0.05  # [m], least clearance
_BEFORE = 1.0  # [m], greatest clearance before a surface
_UPRIGHT = 0.5  # [-], least horizontal part of its normal
_ARRIVING = 4.0  # [m], greatest distance from the goal of those that are near it
_CANDIDATES = 8  # for each state
_TURN = 0.6  # [rad], standard deviation of the yaw about the way, or about the nearest surface
_LEAN = 0.12  # [rad], standard deviation of roll and pitch
_BRAKING = 3.0  # [m/s^2], with which none is too fast to stop before the nearest surface
_SIDEWAYS = 0.3  # [m/s], standard deviation


def draw_off_path(
    labeler: Labeler, count: int, speed: float, rng: np.random.Generator
) -> np.ndarray:
    """
    Draws states (count, 13) from which a path leads to the goal.

    Half are within a meter of a surface other than the ground and look at it.
    Of the others half are within 4 m of the goal, uniform in distance, and look anywhere; half are
    uniform in space and look along the path. All deviate from that, and fly where they look, at up
    to `speed` [m/s] and no faster than they can stop.

    Raises:
        InfeasibleFlightError: if there is no free position.
    """
    field, toa = labeler.field, labeler.toa
    cells = np.argwhere(toa.reachable & (field.distances > VEHICLE_RADIUS + _CLEARANCE))
    if len(cells) == 0:
        raise InfeasibleFlightError("no position from which a path leads to the goal is free")
    centers = field.lower_W + field.voxel_size * (cells + 0.5)
    candidates = centers[rng.integers(len(centers), size=_CANDIDATES * count)]
    to_goal = np.linalg.norm(centers - toa.p_WG, axis=1)
    share = np.where(to_goal < _ARRIVING, 1.0 / np.maximum(to_goal, field.voxel_size) ** 2, 0.0)
    near = count // 4 if share.any() else 0
    arriving = centers[rng.choice(len(centers), near, p=share / share.sum())] if near else []
    candidates = np.concatenate([np.reshape(arriving, (-1, 3)), candidates])
    seen = field.query(candidates)
    before = np.linalg.norm(seen.gradient[:, :2], axis=1) > _UPRIGHT
    before &= seen.distance < VEHICLE_RADIUS + _BEFORE
    before[:near] = False
    before = np.flatnonzero(before)[: count // 2]
    chosen = np.concatenate([before, np.arange(count - len(before))])
    p_WB, distance = candidates[chosen], seen.distance[chosen]
    toward = toa.gradient(p_WB)
    toward[: len(before)] = seen.gradient[before]
    yaw = np.arctan2(-toward[:, 1], -toward[:, 0]) + _TURN * rng.normal(size=count)
    yaw[len(before) : len(before) + near] = rng.uniform(-np.pi, np.pi, near)
    roll, pitch = _LEAN * rng.normal(size=(2, count))
    fastest = np.sqrt(2.0 * _BRAKING * np.maximum(distance - VEHICLE_RADIUS, 0.0))
    ahead = np.minimum(speed, fastest) * rng.random(count)
    aside, up = _SIDEWAYS * rng.normal(size=(2, count))
    cos, sin = np.cos(yaw), np.sin(yaw)
    v_WB = np.stack([cos * ahead - sin * aside, sin * ahead + cos * aside, up], axis=1)
    return np.stack(
        [
            QuadrotorState(
                p_WB[n],
                v_WB[n],
                RollPitchYaw(roll[n], pitch[n], yaw[n]).ToQuaternion().wxyz(),
                np.zeros(3),
            ).to_vector()
            for n in range(count)
        ]
    )


_START_CLEARANCE = 0.3  # [m]


def collect_world(folder: Path, config: CorpusConfig, index: int, revision: str) -> None:
    """
    Collects the world `index` of the library: its record, then its shards.

    Args:
        folder: of the corpus.
        config: of the corpus.
        index: see `world_source`.
        revision: of the program.

    Raises:
        InfeasibleFlightError: if there is no such world, or its goal cannot be flown to.
        OSError: if it cannot be written.
    """
    source = world_source(config.worlds, config.seed, index)
    world = make_world(source.world, source.seed)
    labeler = Labeler(world.esdf, world.p_WG, config.expert)
    record_world(folder / "worlds" / source.name, source, world.esdf)
    _collect_off_path(folder, config, source, world, labeler, revision)
    rngs = [np.random.default_rng([config.seed, source.seed, k]) for k in range(config.flights)]
    starts = np.stack([world.p_WS, *(_draw_start(labeler, world.p_WS, rng) for rng in rngs[1:])])
    parts, entries = [], []
    for number, (flight, rng) in enumerate(
        zip(_fly(starts, world, config, labeler), rngs, strict=True)
    ):
        labels = flight.labels if flight.is_demonstration else []
        demonstrations = keep_clear(labels, labeler.field)
        bound = source.perturbation_bound
        parts.append(see_states(demonstrations, world, labeler, config, bound, rng))
        entries.append(
            {
                "flight": number,
                "seed": source.seed,
                "start": starts[number].tolist(),
                "goal": world.p_WG.tolist(),
                "outcome": str(flight.outcome),
                "time_s": flight.time,
                "least_clearance_m": flight.least_clearance,
                "states": len(demonstrations),
            }
        )
    write_shard(
        shard_folder(folder, source.name),
        parts,
        config.size,
        world=source.name,
        source=EXPERT,
        flights=entries,
        revision=revision,
    )


def shard_folder(folder: Path, world: str, source: int = EXPERT) -> Path:
    """Names the folder of a world's samples of a source."""
    return folder / "shards" / f"{SOURCES[source]}-{world}"


def _collect_off_path(
    folder: Path,
    config: CorpusConfig,
    source: WorldSource,
    world: World,
    labeler: Labeler,
    revision: str,
) -> None:
    """Writes the shard of states off the expert's paths, if the corpus has any."""
    if not config.off_path:
        return
    alone = replace(config, perturbation=replace(config.perturbation, copies=0))
    parts = []
    for first in range(0, config.off_path, STATES_A_LOOK):
        # The expert's flights have the numbers from 0 on.
        rng = np.random.default_rng([config.seed, source.seed, config.flights + first])
        count = min(STATES_A_LOOK, config.off_path - first)
        states = draw_off_path(labeler, count, config.expert.speed, rng)
        demonstrations = keep_clear(labeler.labels(states), labeler.field)
        bound = source.perturbation_bound
        parts.append(see_states(demonstrations, world, labeler, alone, bound, rng))
    write_shard(
        shard_folder(folder, source.name, OFF_PATH),
        parts,
        config.size,
        world=source.name,
        source=OFF_PATH,
        flights=[{"states": sum(map(len, parts))}],
        revision=revision,
    )


def _fly(
    starts: np.ndarray, world: World, config: CorpusConfig, labeler: Labeler
) -> Iterable[ExpertFlight]:
    """Flies the expert from each of the starts (N, 3) [m] to the goal of the world."""
    if config.expert.policy == PLANNER:
        return fly_planner(starts, world, config.expert, labeler)
    scenarios = (Scenario(start=start, start_radius=0.0) for start in starts.tolist())
    return (fly_policy(scenario, world, config.expert, labeler) for scenario in scenarios)


def _draw_start(labeler: Labeler, p_WS: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draws a free position (3,) [m], at least half as far from the goal as p_WS (3,) [m]."""
    field, toa = labeler.field, labeler.toa
    roomy = toa.reachable & (field.distances > VEHICLE_RADIUS + _START_CLEARANCE)
    cells = np.argwhere(roomy & (toa.times > 0.5 * toa.value(p_WS)))
    if len(cells) == 0:
        raise InfeasibleFlightError("no position half as far from the goal as the start is free")
    return field.lower_W + field.voxel_size * (cells[rng.integers(len(cells))] + 0.5)


@holds_folder("out")
def run(*, config: CorpusConfig, out: Path, worlds: int, jobs: int | None = None) -> Corpus:
    """
    Collects the first `worlds` worlds of a corpus in `out`, except those that it has already.

    An interrupted run is resumed by the same call, with bitwise identical results. Damaged shards
    are collected again.

    Args:
        config: configuration, which determines every sample.
        out: folder; see `splatpilot.training.corpus.corpus`.
        worlds: number of worlds.
        jobs: worker processes; one for each core by default.

    Returns:
        The corpus.

    Raises:
        FileNotFoundError, ValueError: on a config out of range, another corpus in `out`, a shard
            of another version, or if nothing was collected.
        OSError: if `out` cannot be written, or a worker process dies.
    """
    try:
        config.validate()
    except FieldError as error:
        raise error.within(config) from None
    jobs = available_cores() if jobs is None else jobs
    require(jobs >= 1, "--jobs", "at least 1", jobs)
    require(worlds >= 1, "--worlds", "at least 1", worlds)
    sources = [world_source(config.worlds, config.seed, k) for k in range(worlds)]
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
        if k in damage:
            say(f"{damage[k]}: {sources[k].name} is collected again")
        _remove(out, sources[k].name)
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
    write_ledger(out, corpus)
    return corpus


def _damage(out: Path, source: WorldSource, config: CorpusConfig) -> str:
    """Describes the damage of a collected world; empty if there is none.

    Raises:
        ValueError: if it is of another version or definition.
    """
    try:
        record = WorldRecord(out / "worlds" / source.name)
        record.esdf()
        Shard(shard_folder(out, source.name)).verify()
        if config.off_path:
            Shard(shard_folder(out, source.name, OFF_PATH)).verify()
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
    """Raises ValueError if another program collected what is there, except for recovery."""
    for path in entries(out / "shards"):
        try:
            shard = Shard(path)
        except ValueError:  # it is damaged
            continue
        if shard.source != RECOVERY and shard.revision != program:
            raise ValueError(
                f"{shard.path} was collected by revision {shard.revision} of the program, this is "
                f"{program}, and one corpus is collected by one program; go back to that revision, "
                "or collect more worlds with another seed in another --out"
            )


def _remove(out: Path, world: str) -> None:
    """Removes the incomplete or damaged folders of a world."""
    shutil.rmtree(out / "worlds" / world, ignore_errors=True)
    for source in (OFF_PATH, EXPERT):
        shutil.rmtree(shard_folder(out, world, source), ignore_errors=True)


def _collect(out: Path, config: CorpusConfig, revision: str, index: int) -> str:
    """Collects a world; returns the reason if it is infeasible."""
    try:
        collect_world(out, config, index, revision)
    except InfeasibleFlightError as error:
        return f"world {index} is left out: {error}"
    return ""
