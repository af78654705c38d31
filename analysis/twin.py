"""`splatpilot scene twin`: how well flights in scenes predict flights in what was captured.

The scenes are of rendered captures. Each policy flies from the same starts to the same goals in the
scene and in the mesh that the capture shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from splatpilot.analysis.benchmark import run_study
from splatpilot.analysis.benchmark.study import StudyConfig, scenario_texts
from splatpilot.analysis.benchmark.tables import Row
from splatpilot.analysis.benchmark.variants import parse_variant
from splatpilot.analysis.figures import write_png
from splatpilot.diagrams.flight.policies import DEFAULT_SPEED
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.worlds.file_worlds import MeshWorld
from splatpilot.diagrams.worlds.scene_folder import (
    SceneConfig,
    draw_ends,
    read_scene_folder,
    read_scene_metadata,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.files import write_csv
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import Config, bounded, require, require_field
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.training.captures.render import RECIPE, rendered_world

POLICIES = (
    "planner",
    "straight",
    "reactive",
    "close=reactive:margin=0.0:barrier_margin=0.2",
    "diffaero",
    "diffaero@4",
    "diffaero@8",
    "depthnav",
    "depthnav@4",
    "depthnav@8",
    "agile_autonomy",
    "student_depth",
    "student_rgb",
    "diffaero_rgb",
    "diffaero_rgb@4",
)
"""Default policies: of all kinds, and at speeds at which they fail."""

_AT = "@"  # between policy and speed
_DRAWS = 5  # routes that are drawn at most, for each that is flown
_RESAMPLES = 10_000


@dataclass
class TwinConfig(Config):
    """Policies and routes that are flown."""

    # "[LABEL=]POLICY[:FIELD=VALUE...][@SPEED]" each, with the nominal speed, by default 2 m/s.
    policies: list[str] = field(default_factory=lambda: list(POLICIES))
    # [-] Starts and goals in each scene.
    routes: int = bounded(20, "[2, 1000]")
    # [s] Flights end after this time.
    timeout: float = bounded(30.0, "(0, 3600] s")
    # [m] The meshes are flown again from starts within this distance, to learn how well flights in
    # one environment agree with each other; 0: they are not.
    repeat_radius: float = bounded(0.0, "[0, 1] m")
    # Generated scenarios that are flown with as many seeds, as another prediction.
    control: list[str] = field(default_factory=lambda: ["P02", "P04"])

    def check(self) -> None:
        require_field(self, "policies", self.policies, "one policy or more")


class Route(NamedTuple):
    """A start and a goal [m], in the world frame of the scene."""

    p_WS: NDArray[np.float64]
    p_WG: NDArray[np.float64]


def run(
    *, scenes: Sequence[Path], out: Path, config: TwinConfig, jobs: int | None = None
) -> list[dict[str, Any]]:
    """Flies all policies in scenes and in their meshes, and writes `flights.csv`, `twin.csv` and
    `twin.png`. The same call resumes, and with more scenes flies what is missing. Returns the rows
    of `twin.csv`, see `predictions`."""
    config.validate()
    by_speed = policies_by_speed(config.policies)
    if config.control:  # Its errors are found before hours of flights.
        for speed, policies in by_speed.items():
            StudyConfig(config.control, policies, [speed], seeds=config.routes).load_scenarios()
    given, texts = twin_scenarios(scenes, config)
    rows, generated = [], []
    for speed, policies in by_speed.items():
        study = StudyConfig(texts, policies, [speed], seeds=1)
        study.overrides = [f"timeout={config.timeout}"]
        options: dict[str, Any] = {"jobs": jobs, "report": False}
        folder = out / f"{speed:g}m_s"
        rows += run_study.run(config=study, out=folder / "twins", given=given, **options).rows
        if config.control:
            study = replace(study, scenarios=list(config.control), seeds=config.routes)
            generated += run_study.run(config=study, out=folder / "control", **options).rows
    pairs = paired_flights(rows)
    write_csv(out / "flights.csv", pairs)
    table = predictions(pairs, generated)
    write_csv(out / "twin.csv", table)
    _write_figure(out / "twin.png", pairs, generated)
    _print_table(table)
    print(f"Wrote flights.csv, twin.csv and twin.png in {out}")
    return table


def twin_scenarios(
    scenes: Sequence[Path], config: TwinConfig
) -> tuple[dict[str, Scenario], list[str]]:
    """Returns scenarios by name, and texts for `parse_scenario` of all routes through them, labeled
    "SCENE.KIND.ROUTE", where KIND is splat, mesh or again."""
    names = [scene.resolve().name for scene in scenes]
    unique = len(set(names)) == len(names)
    require(unique, "names of scenes", "different", ", ".join(names), "rename one folder")
    given, texts = {}, []
    for name, scene in zip(names, scenes, strict=True):
        mesh = captured_mesh(scene)
        routes = draw_routes(scene, make_world(mesh, 0), config.routes)
        kinds = [("splat", SceneConfig(path=str(scene.resolve())), 0.0), ("mesh", mesh, 0.0)]
        if config.repeat_radius:
            kinds.append(("again", mesh, config.repeat_radius))
        for kind, world, radius in kinds:
            given[f"{name}.{kind}"] = Scenario(world=world, start_radius=radius)
            ends = [{"start": each.p_WS.tolist(), "goal": each.p_WG.tolist()} for each in routes]
            flights = scenario_texts([f"{name}.{kind}"], ends)
            texts += [f"{name}.{kind}.{k}={text}" for k, text in enumerate(flights)]
    return given, texts


def policies_by_speed(policies: Sequence[str]) -> dict[float, list[str]]:
    """Returns the policies of `TwinConfig`, as `parse_variant` reads them, by speed [m/s]."""
    groups: dict[float, list[str]] = {}
    for text in policies:
        policy, _, speed = text.partition(_AT)
        try:
            nominal = float(speed or DEFAULT_SPEED)
        except ValueError:
            raise ValueError(f"the speed of {text} must be a number [m/s], got {speed}") from None
        parse_variant(policy).config(nominal, None)
        groups.setdefault(nominal, []).append(policy)
    return groups


def captured_mesh(scene: Path) -> MeshWorld:
    """Returns the mesh that the capture of the scene folder `scene` was rendered of."""
    capture = read_scene_metadata(scene).capture
    recipe = rendered_world(Path(capture)) if capture else None
    if recipe is None:
        raise ValueError(
            f"{scene} must be of a rendered capture, got {capture or 'an unknown one'} without "
            f"{RECIPE}; render one by `splatpilot capture render`"
        )
    same = {name: getattr(recipe.config, name) for name in ("up", "scale", "background")}
    return MeshWorld(path=str(Path(capture) / recipe.mesh), **same)


def draw_routes(scene: Path, mesh: World, count: int) -> list[Route]:
    """Draws `count` starts and goals in well-observed space of the scene folder `scene`, that a
    path in the mesh connects, too. Others are skipped, and said."""
    esdf = mesh.esdf.conservative()
    config, world = SceneConfig(path=str(scene.resolve())), read_scene_folder(scene)
    routes, reason = [], ""
    seeds = iter(range(_DRAWS * count))
    for _ in Progress(range(count), f"routes of {scene.name}", unit="route"):
        for seed in seeds:
            try:
                drawn = draw_ends(config, world, seed)
                if not time_of_arrival(esdf, drawn.p_WG).is_reachable(drawn.p_WS):
                    raise InfeasibleFlightError("no path in the mesh")
            except InfeasibleFlightError as error:
                reason = str(error)
                continue
            routes.append(Route(np.round(drawn.p_WS, 3), np.round(drawn.p_WG, 3)))
            break
    if reason:
        print(f"{scene.name}: some routes are skipped, the last for: {reason}")
    require(len(routes) == count, f"routes in {scene}", f"{count}", len(routes), "ask for fewer")
    return routes


def paired_flights(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Returns a row for each environment, policy and route, with the success, outcome and minimum
    clearance [m] of the flight in the splat, in the mesh, and in the mesh again."""
    pairs: dict[tuple[str, str, int], dict[str, Any]] = {}
    for row in rows:
        name, kind, route = row["scenario"].rsplit(".", 2)
        key = name, _flown_policy(row), int(route)
        pair = pairs.setdefault(key, {"environment": name, "policy": key[1], "route": key[2]})
        pair[kind] = int(row["success"])
        pair[f"{kind}_outcome"] = row["outcome"]
        clearance = row.get("min_clearance_m")
        pair[f"{kind}_clearance_m"] = "" if clearance in (None, "") else round(clearance, 3)
    return list(pairs.values())


def _flown_policy(row: Row) -> str:
    speed = f"{row['speed']:g}" if row["speed"] != DEFAULT_SPEED else ""
    return row["policy"] + (_AT + speed if speed else "")


def predictions(
    pairs: Sequence[dict[str, Any]], control: Sequence[Row] = ()
) -> list[dict[str, Any]]:
    """Computes how well flights in the splat predict those in the mesh: for each environment, and
    for all of them together.

    Each row has `flights`, the success rates `mesh` and `splat`, `agreement`, the fraction of
    flights with the same success, Cohen's `kappa`, the same of the `again` flights if there are
    any, and Spearman's rank correlation of the policies' success rates in splat and mesh, `rho`.
    `control` is that of their success in generated scenarios instead. `_low` and `_high` are 95 %
    percentile intervals of a bootstrap that draws policies and, in each environment, routes.
    """
    environments = list(dict.fromkeys(pair["environment"] for pair in pairs))
    policies = list(dict.fromkeys(pair["policy"] for pair in pairs))
    kinds = [kind for kind in ("splat", "mesh", "again") if kind in pairs[0]]
    cubes = {kind: _cube(pairs, kind, environments, policies) for kind in kinds}
    found = ([row["success"] for row in control if _flown_policy(row) == p] for p in policies)
    generated = np.array([np.mean(successes or [np.nan]) for successes in found])
    table = []
    parts = [(name, slice(k, k + 1)) for k, name in enumerate(environments)]
    for name, part in [*parts, ("all", slice(None))]:
        mesh, splat = cubes["mesh"][part], cubes["splat"][part]
        row: dict[str, Any] = {"environment": name, "flights": mesh.size}
        row |= {"mesh": mesh.mean(), "splat": splat.mean()}
        for kind, prefix in (("splat", ""), ("again", "again_")):
            if kind not in cubes:
                continue
            other = cubes[kind][part]
            row[f"{prefix}agreement"] = np.mean(mesh == other)
            row[f"{prefix}kappa"] = cohen_kappa(mesh, other)
        row |= _correlations(mesh, splat, generated)
        table.append({name: round(x, 4) if isinstance(x, float) else x for name, x in row.items()})
    return table


def _cube(
    pairs: Sequence[dict[str, Any]], kind: str, environments: list[str], policies: list[str]
) -> NDArray[np.float64]:
    """Returns successes (environments, policies, routes)."""
    routes = 1 + max(pair["route"] for pair in pairs)
    cube = np.full((len(environments), len(policies), routes), np.nan)
    for pair in pairs:
        k = environments.index(pair["environment"]), policies.index(pair["policy"])
        cube[*k, pair["route"]] = pair[kind]
    require(np.isfinite(cube).all(), "flights", "complete", "missing ones", "run it again")
    return cube


def _correlations(
    mesh: NDArray[np.float64], splat: NDArray[np.float64], generated: NDArray[np.float64]
) -> dict[str, float]:
    """Returns `rho` and `control` with intervals, of successes (E, P, R) and rates (P,)."""
    count, num_policies, num_routes = mesh.shape
    rng = np.random.default_rng(0)
    rates = np.empty((3, _RESAMPLES + 1, num_policies))
    for k in range(_RESAMPLES + 1):
        routes = rng.integers(num_routes, size=(count, 1, num_routes))
        chosen = rng.integers(num_policies, size=num_policies)
        if k == 0:  # what was flown
            routes[:], chosen = np.arange(num_routes), np.arange(num_policies)
        for i, each in enumerate((mesh, splat)):
            rates[i, k] = np.take_along_axis(each, routes, axis=2).mean(axis=(0, 2))[chosen]
        rates[2, k] = generated[chosen]
    result = {}
    for name, predicted in (("rho", rates[1]), ("control", rates[2])):
        rho = rank_correlations(rates[0], predicted)
        known = rho[np.isfinite(rho)]
        low, high = np.quantile(known, [0.025, 0.975]) if len(known) else (np.nan, np.nan)
        result |= {name: float(rho[0]), f"{name}_low": float(low), f"{name}_high": float(high)}
    return result


def rank_correlations(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[Any]:
    """Computes Spearman's rank correlations (N,) of rows (N, P); NaN for constant rows."""
    ranks = (rankdata(each, axis=1, nan_policy="propagate") for each in (first, second))
    x, y = (each - each.mean(axis=1, keepdims=True) for each in ranks)
    with np.errstate(invalid="ignore"):
        return (x * y).sum(axis=1) / np.sqrt((x * x).sum(axis=1) * (y * y).sum(axis=1))


def cohen_kappa(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Computes the agreement of successes beyond that of chance (J. Cohen, 1960); NaN if chance
    agrees always."""
    p, q = first.mean(), second.mean()
    chance = p * q + (1 - p) * (1 - q)
    return float((np.mean(first == second) - chance) / (1 - chance)) if chance < 1 else np.nan


def _print_table(table: Sequence[dict[str, Any]]) -> None:
    for row in table:
        rho, control = (
            "{:.3f} [{:.3f}, {:.3f}]".format(*(row[name + end] for end in ("", "_low", "_high")))
            for name in ("rho", "control")
        )
        print(
            f"{row['environment']}: {row['flights']} flights, success {row['mesh']:.1%} in the "
            f"mesh and {row['splat']:.1%} in the splat, {row['agreement']:.1%} agree (kappa "
            f"{row['kappa']:.2f}), rank correlation {rho}, of the control {control}"
        )


def _write_figure(path: Path, pairs: Sequence[dict[str, Any]], control: Sequence[Row]) -> None:
    """Draws each policy's success in the mesh against that in the splat and the control."""
    from matplotlib.figure import Figure

    policies = list(dict.fromkeys(pair["policy"] for pair in pairs))
    figure = Figure(figsize=(10, 4), layout="constrained")
    flights = [row | {"policy": _flown_policy(row)} for row in control]
    drawn = {"reconstructions": (pairs, "splat"), "generated worlds": (flights, "success")}
    panels = figure.subplots(1, 2 if control else 1, sharey=True, squeeze=False)[0]

    def rate(rows: Sequence[Row], policy: str, column: str) -> float:
        return float(np.mean([row[column] for row in rows if row["policy"] == policy]))

    for axes, (where, (rows, column)) in zip(panels, drawn.items(), strict=False):
        for policy, marker in zip(policies, cycle("os^vDPX*<>"), strict=False):
            xy = rate(rows, policy, column), rate(pairs, policy, "mesh")
            axes.plot(*xy, marker, alpha=0.7, markersize=8, clip_on=False, label=policy)
        axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
        axes.set(xlabel=f"success in {where}", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
        axes.set_aspect("equal")
    panels[0].set_ylabel("success in the meshes")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")
    write_png(figure, path)
