"""The report of a study: one HTML file that needs nothing else."""

import io
import math
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from splatpilot.analysis.benchmark import html_page
from splatpilot.analysis.benchmark.external import external_section, external_table
from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder, kept_flights, kept_scenario
from splatpilot.analysis.benchmark.tables import (
    FAILURES,
    IN_DISTRIBUTION,
    PAPER_FLIGHTS,
    PaperRow,
    compare,
    mean_of,
    paper_rows,
    select,
    success_summary,
)
from splatpilot.diagrams.flight.blocks import goal_position
from splatpilot.diagrams.worlds.scene_folder import SceneSource
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.files import written_atomically
from splatpilot.systems.common.seeds import SPLIT_NAMES, describe_seeds
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState

matplotlib.use("Agg")

_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
_MARKERS = "osD^vP*X"
_OBSTACLE, _TOO_NEAR, _SPACING = "#5b5f66", "#d9dbde", 0.05  # the last in [m]


def policy_color(policy: str, policies: list[str]) -> str:
    """The colour of a policy, the same in all pictures of a study."""
    return _COLORS[policies.index(policy) % len(_COLORS)]


def draw_success_against_speed(
    table: list[dict[str, Any]], policies: list[str], paper: dict[str, PaperRow]
) -> Figure:
    """Fig. 5: success rate with its 95 % interval against mean flight velocity, a line for each
    policy through its nominal speeds; the paper's points beside those of the same policies."""
    figure, axes = plt.subplots(figsize=(7.2, 4.6), layout="constrained")
    for policy in policies:
        rows = [row for row in table if row["policy"] == policy and row["flights"]]
        rows.sort(key=lambda row: row["speed"])
        if not rows:
            continue
        speeds, rates, lower, upper = (
            np.array([row[name] for row in rows])
            for name in ("mean_speed_m_s", "success_rate", "wilson_lower", "wilson_upper")
        )
        color, marker = policy_color(policy, policies), _MARKERS[policies.index(policy) % 8]
        axes.errorbar(
            speeds,
            100 * rates,
            yerr=100 * np.maximum([rates - lower, upper - rates], 0.0),
            color=color,
            marker=marker,
            capsize=3,
            label=policy,
        )
        if policy in paper:
            theirs = paper[policy]
            axes.plot(
                theirs.mean_speed_m_s,
                100 * theirs.successes / PAPER_FLIGHTS,
                marker,
                mfc="none",
                mec=color,
                ms=10,
                label=f"{theirs.method} (paper)",
            )
    axes.set(xlabel="mean flight velocity [m/s]", ylabel="success rate [%]", ylim=(-3, 103))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def draw_field_from_above(axes: Axes, world: World, height: float) -> None:
    """Obstacles at a height [m], cut out of the distance field, and around them where the vehicle's
    centre cannot be."""
    field = world.distance_field
    x, y = (
        np.arange(low + _SPACING / 2, high, _SPACING)
        for low, high in zip(field.lower_W[:2], field.upper_W[:2], strict=True)
    )
    points = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), height)], axis=-1)
    distance = np.nan_to_num(field.distance(points), nan=np.inf)
    distance = np.minimum(distance, 10.0)
    levels = [-1e3, 0.0, VEHICLE_RADIUS]
    axes.contourf(x, y, distance, levels=levels, colors=[_OBSTACLE, _TOO_NEAR])
    axes.set_aspect("equal")
    axes.set_xlim(field.lower_W[0], field.upper_W[0])
    axes.set_ylim(field.lower_W[1], field.upper_W[1])


def draw_trajectories(
    world: World,
    flights: dict[str, tuple[np.ndarray, str]],
    p_WS: np.ndarray,
    p_WG: np.ndarray,
    policies: list[str],
    title: str,
) -> Figure:
    """Fig. 6: flights through one field from above.

    Args:
        world: the field.
        flights: by policy, the positions p_WB (N, 3) [m] and the outcome.
        p_WS, p_WG: start and goal (3,) [m].
        policies: of the study, for their colours.
        title: of the picture.
    """
    extent = world.distance_field.upper_W - world.distance_field.lower_W
    height = float(np.clip(9.0 * extent[1] / extent[0], 2.5, 9.0)) + 0.9
    figure, axes = plt.subplots(figsize=(9.0, height), layout="constrained")
    draw_field_from_above(axes, world, float(p_WG[2]))
    for policy, (p_WB, outcome) in flights.items():
        color = policy_color(policy, policies)
        axes.plot(p_WB[:, 0], p_WB[:, 1], color=color, lw=1.8, label=f"{policy}: {outcome}")
        if outcome != "goal" and len(p_WB):
            axes.plot(*p_WB[-1, :2], "X", color=color, ms=10, mec="white", zorder=5)
    axes.plot(*p_WS[:2], "o", color="black", ms=7, zorder=5)
    axes.plot(*p_WG[:2], "*", color="black", ms=13, zorder=5)
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title)
    if flights:
        axes.legend(
            frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=len(flights)
        )
    return figure


def save_png(figure: Figure, path: Path) -> bytes:
    """Writes a picture, closes it, and returns the file's bytes: the same for the same picture."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130, metadata={"Software": None})
    plt.close(figure)
    with written_atomically(path) as partial:
        partial.write_bytes(buffer.getvalue())
    return buffer.getvalue()


def trajectories_section(
    folder: StudyFolder, config: StudyConfig, rows: list[dict[str, Any]]
) -> str:
    """HTML of `trajectories.png`, which it writes: flights through the field that tells most."""
    spec = _telling_flight(rows)
    if spec is None:
        return "<p>Nothing was flown.</p>"
    _, scenario = next(kept_flights(folder, [spec]))
    world = make_world(scenario.world, scenario.seed)
    flights = {}
    for policy in config.policy_names:
        row, arrays = folder.read(spec._replace(policy=policy))
        if arrays:
            flights[policy] = QuadrotorState.of(arrays["states"]).p_WB, row["outcome"]
    p_WS = next((p_WB[0] for p_WB, _ in flights.values()), world.p_WS)
    title = f"{spec.scenario}, seed {spec.seed}, {spec.speed:g} m/s"
    figure = draw_trajectories(
        world, flights, p_WS, goal_position(scenario, world), config.policy_names, title
    )
    png = save_png(figure, folder.path / "trajectories.png")
    note = (
        '<p class="note">Dark: obstacles at the height of the goal, cut out of the distance field; '
        "light: where the vehicle's centre would touch them.</p>"
    )
    return html_page.image(png, title) + note


def _telling_flight(rows: list[dict[str, Any]]) -> RolloutSpec | None:
    """The field whose flights differ most in how they end, the first of equals."""
    fields: dict[tuple, list[dict[str, Any]]] = {}
    for row in rows:
        fields.setdefault((row["scenario"], row["speed"], row["seed"]), []).append(row)

    def variety(flown: list[dict[str, Any]]) -> tuple[int, int, float]:
        wins = sum(row["success"] for row in flown)
        length = sum(row.get("path_length_m", 0.0) for row in flown)
        return min(wins, len(flown) - wins), wins, length

    if not fields:
        return None
    row = max(fields.values(), key=variety)[0]
    return RolloutSpec(row["scenario"], row["policy"], row["speed"], row["seed"])


_COMPARED = ("min_clearance_m", "+.2f"), ("mean_speed_m_s", ".2f")


def write_report(
    folder: StudyFolder,
    config: StudyConfig,
    rows: list[dict[str, Any]],
    timings: list[dict[str, Any]],
    table: list[dict[str, Any]],
    absent: dict[str, str],
    damaged: list[str],
) -> None:
    """
    Writes `report.html` and its pictures, `success_against_speed.png` and `trajectories.png`.

    Args:
        folder, config: the study.
        rows: of its flights.
        timings: of the same flights.
        table: `policy_table` of them.
        absent: the scenarios that were not flown, and why.
        damaged: files that were flown again in this run.
    """
    paper = paper_rows(config, absent)
    seeds = SPLIT_NAMES[config.split] + " seeds"
    figure = draw_success_against_speed(table, config.policy_names, paper)
    success_png = save_png(figure, folder.path / "success_against_speed.png")
    sections = [
        f"<h1>Navigation benchmark, {seeds}</h1><p>{_scope(config, rows)}</p>",
        _warnings(config, rows, absent, damaged),
        f"<h2>Policies, {seeds}</h2>" + _policies(table) + _timing(config, rows, timings),
        f"<h2>Beside the paper's Table I, {seeds}</h2>" + _paper(table, paper) if paper else "",
        external_section(external_table(rows, config), seeds),
        f"<h2>Success against speed, {seeds}</h2>"
        + html_page.image(success_png, "Success rate against velocity, with Wilson's intervals"),
        "<h2>Trajectories through one field</h2>" + trajectories_section(folder, config, rows),
        f"<h2>Pairs of policies on the same flights, {seeds}</h2>" + _pairs(config, rows),
        f"<h2>Scenarios, {seeds}</h2>" + _scenarios(folder, config, rows, absent),
        "<h2>Flights</h2>" + _flights(folder, config, rows),
        "<h2>Program</h2>" + _program(folder),
    ]
    with written_atomically(folder.path / "report.html") as path:
        path.write_text(html_page.page(f"Navigation benchmark, {seeds}", sections))


def _rate(summary: dict[str, Any]) -> str:
    if not summary["flights"]:
        return "not run"
    return (
        f"{summary['success_rate']:.0%} <span class=note>[{summary['wilson_lower']:.0%}, "
        f"{summary['wilson_upper']:.0%}]</span>"
    )


def _clusters(row: dict[str, Any]) -> str:
    return f"<span class=note>[{row['cluster_lower']:.0%}, {row['cluster_upper']:.0%}]</span>"


def _passed(row: dict[str, Any]) -> str:
    return f"{row['scenarios_passed']}/{row['scenarios']}"


def _scope(config: StudyConfig, rows: list[dict[str, Any]]) -> str:
    speeds = ", ".join(f"{speed:g}" for speed in config.speeds)
    return (
        f"{len(rows)} flights: {len(config.scenarios)} scenarios, {len(config.policies)} policies, "
        f"{describe_seeds(config.split, config.seeds)}, nominal speeds {speeds} m/s. A flight "
        "succeeds when it reaches the goal and its clearance at the vehicle's radius is never "
        "below zero. Brackets are 95 % intervals: Wilson's, for these scenarios with new seeds, "
        "and under “new scenarios” those of a bootstrap over scenarios, for others of the same "
        "kinds."
    )


def _warnings(
    config: StudyConfig, rows: list[dict[str, Any]], absent: dict[str, str], damaged: list[str]
) -> str:
    lines = [
        f"<b>{escape(name)} was not run</b>, and counts nowhere: {escape(reason)}"
        for name, reason in absent.items()
    ]
    lines += [f"{escape(problem)}; the flight was flown again" for problem in damaged]
    lines += [
        f"{escape(row['id'])}, {row['outcome']}, counts as a failure: {escape(row['reason'])}"
        for row in rows
        if "reason" in row
    ]
    return "".join(f'<p class="warn">{line}</p>' for line in lines)


def _policies(table: list[dict[str, Any]]) -> str:
    header = ["policy", "speed [m/s]", "flights", "success", "new scenarios"]
    header += [outcome.replace("_", " ") for outcome in FAILURES]
    header += ["not run", "scenarios passed", "min. clearance [m]"]
    header += ["velocity [m/s]", "path excess"]
    header += ["jerk [m/s³]", "smoothness"]
    rows = [
        [
            escape(row["policy"]),
            f"{row['speed']:g}",
            str(row["flights"]),
            _rate(row),
            _clusters(row),
            *(str(row[outcome]) for outcome in FAILURES),
            str(row["not_run"]),
            _passed(row),
            html_page.number(row["min_clearance_m"], "+.2f"),
            html_page.number(row["mean_speed_m_s"], ".2f"),
            html_page.number(row["path_excess"], ".1%"),
            html_page.number(row["jerk_m_s3"], ".1f"),
            html_page.number(row["smoothness"], ".1f"),
        ]
        for row in table
    ]
    return html_page.table(header, rows)


def _timing(config: StudyConfig, rows: list[dict[str, Any]], timings: list[dict[str, Any]]) -> str:
    header = ["policy", "decision [ms]", "render [ms]", "real-time factor"]
    names = "policy_ms", "render_ms", "real_time_factor"
    lines = []
    for policy in config.policy_names:
        times = [t for r, t in zip(rows, timings, strict=True) if r["policy"] == policy]
        lines.append(
            [escape(policy), *(html_page.number(mean_of(times, name), ".1f") for name in names)]
        )
    return "<p>Mean times, of this machine and its load:</p>" + html_page.table(header, lines)


def _paper(table: list[dict[str, Any]], paper: dict[str, PaperRow]) -> str:
    header = ["policy", "method in the paper", "success, paper", "success, here", "new scenarios"]
    header += [
        "scenarios passed",
        "clearance, paper [m]",
        "here [m]",
        "velocity, paper [m/s]",
        "here [m/s]",
    ]
    rows = []
    for row in table:
        if row["policy"] not in paper:
            continue
        theirs = paper[row["policy"]]
        name = f"{row['policy']} at {row['speed']:g} m/s"
        there = f"{theirs.successes}/{PAPER_FLIGHTS} ({theirs.successes / PAPER_FLIGHTS:.0%})"
        cells = [name, theirs.method, there, _rate(row), _clusters(row), _passed(row)]
        for measure, form in _COMPARED:
            cells += [f"{getattr(theirs, measure):{form}}", html_page.number(row[measure], form)]
        rows.append(cells)
    note = (
        '<p class="note">The paper flew one flight in each of its own 17 scenarios, in Isaac Sim; '
        "the scenarios here are others of the same kinds, passed where most flights succeed. The "
        "paper's policies were trained in reconstructions of TartanAir. The weights that ship were "
        f"trained in the generators of {', '.join(IN_DISTRIBUTION)}: these scenarios are in their "
        "training distribution, with other seeds; the others are not.</p>"
    )
    return html_page.table(header, rows) + note


def _pairs(config: StudyConfig, rows: list[dict[str, Any]]) -> str:
    lines = [
        [
            f"{escape(pair.first)} and {escape(pair.second)}",
            f"{pair.speed:g}",
            str(pair.only_first),
            str(pair.only_second),
            *(f"{p:.3f}" if p >= 0.001 else f"{p:.0e}" for p in (pair.p_seeds, pair.p_scenarios)),
        ]
        for pair in compare(rows, config)
    ]
    if not lines:
        return "<p>One policy: nothing to compare.</p>"
    header = ["policies", "speed [m/s]", "only the first succeeds", "only the second"]
    header += ["p, these scenarios", "p, new scenarios"]
    note = (
        '<p class="note">Exact McNemar tests over flights, for these scenarios with new seeds, and '
        "sign-flip permutation tests over scenarios, for others of the same kinds. Both are "
        f"corrected by Holm for the {len(lines)} pairs.</p>"
    )
    return html_page.table(header, lines) + note


def _scenarios(
    folder: StudyFolder, config: StudyConfig, rows: list[dict[str, Any]], absent: dict[str, str]
) -> str:
    columns = [(policy, speed) for policy in config.policy_names for speed in config.speeds]
    header = ["scenario", *(f"{escape(policy)}<br>{speed:g} m/s" for policy, speed in columns)]
    names = list(dict.fromkeys(spec.scenario for spec in config.rollouts()))
    lines = []
    for name in names:
        cells = []
        for policy, speed in columns:
            flown = select(rows, scenario=name, policy=policy, speed=speed)
            cells.append(_rate(success_summary(flown)))
        lines.append([escape(name) + (" <b>(not run)</b>" if name in absent else ""), *cells])
    flown = [name for name in names if name not in absent]
    worlds = {name: kept_scenario(folder, name).world for name in flown}
    single = [escape(name) for name, world in worlds.items() if isinstance(world, SceneSource)]
    note = (
        f'<p class="note">Each of {", ".join(single)} is one environment: other seeds draw other '
        "starts and goals in it (and other inserted solids), no other environment. Test seeds do "
        "not make it unseen.</p>"
    )
    return html_page.table(header, lines) + (note if single else "")


def _flights(folder: StudyFolder, config: StudyConfig, rows: list[dict[str, Any]]) -> str:
    header = ["flight", "outcome", "time [s]", "min. clearance [m]", "velocity [m/s]", "replay"]
    sections = []
    for name in dict.fromkeys(row["scenario"] for row in rows):
        flown = select(rows, scenario=name)
        lines = [
            [
                escape(row["id"]),
                escape(row["outcome"]),
                html_page.number(row.get("flight_time_s", math.nan), ".1f"),
                html_page.number(row.get("min_clearance_m", math.nan), "+.2f"),
                html_page.number(row.get("mean_speed_m_s", math.nan), ".2f"),
                f"<code>splatpilot replay . {escape(row['id'])} --meshcat</code>",
            ]
            for row in flown
        ]
        sections.append(
            f"<details><summary>{escape(name)}: {len(flown)} flights</summary>"
            f"{html_page.table(header, lines)}</details>"
        )
    note = "<p>The commands run in the folder that holds this report.</p>"
    return note + "".join(sections)


def _program(folder: StudyFolder) -> str:
    rows = [[escape(name), escape(value)] for name, value in folder.program().items()]
    return html_page.table(["part", "version"], rows)
