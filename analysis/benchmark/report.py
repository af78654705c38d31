"""The report of a study: one HTML file without external resources."""

import base64
import math
from html import escape
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder, kept_flights, kept_scenario
from splatpilot.analysis.benchmark.tables import (
    FAILURES,
    IN_DISTRIBUTION,
    PAPER_FLIGHTS,
    SOURCES,
    PaperRow,
    Row,
    compare,
    mean_column,
    paper_rows,
    select,
    success_summary,
)
from splatpilot.analysis.figures import write_png
from splatpilot.diagrams.flight.scenario import goal_position, sample_scenario
from splatpilot.diagrams.worlds.scene_folder import SceneSource
from splatpilot.diagrams.worlds.world_registry import make_world
from splatpilot.systems.common.files import write_text
from splatpilot.systems.common.provenance import SPLIT_NAMES, describe_seeds
from splatpilot.systems.vehicle.state import QuadrotorState

_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
_MARKERS = "osD^vP*X"
_OBSTACLE, _BLOCKED = "#5b5f66", "#d9dbde"
_SPACING = 0.05  # [m], of samples of the distance field
_LEGEND_COLUMNS = 4
_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1360px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.7em; } h2 { font-size: 1.25em; margin-top: 2em; }
table { display: block; overflow-x: auto; border-collapse: collapse; font-size: 14px;
        font-variant-numeric: tabular-nums; margin: .6em 0; }
th, td { padding: .25em .4em; white-space: nowrap; text-align: right;
         border-bottom: 1px solid light-dark(#e3e5e8, #3a3f47); }
th:first-child, td:first-child { text-align: left; }
th { background: light-dark(#f4f5f7, #2a2e35); font-weight: 600; white-space: normal; }
img { max-width: 100%; }
code { background: light-dark(#f4f5f7, #2a2e35); padding: .1em .3em; font-size: 13px; }
details { margin: .3em 0; } summary { cursor: pointer; }
.note { color: light-dark(#555, #aaa); }
.warn { background: light-dark(#fff4d6, #4a3d12); padding: .5em .8em; border-radius: 4px; }
"""
_VIEWPORT = '<meta name="viewport" content="width=device-width, initial-scale=1">'


def write_report(
    folder: StudyFolder,
    config: StudyConfig,
    rows: list[Row],
    timings: list[Row],
    table: list[Row],
    external: list[Row],
    absent: dict[str, str],
    damaged: list[str],
) -> None:
    """Writes `report.html`, `success_against_speed.png` and `trajectories.png`; `absent` has the
    reasons of scenarios that were not flown, `damaged` the errors of files that were flown again.
    """
    paper = paper_rows(config, absent)
    seeds = SPLIT_NAMES[config.split] + " seeds"
    title = f"Navigation benchmark, {seeds}"
    sections = {
        f"Policies, {seeds}": _policies(table) + _timing(config, rows, timings),
        f"Comparison with the paper's Table I, {seeds}": _paper(table, paper),
        f"Comparison with published results, {seeds}": external_section(external),
        f"Success against speed, {seeds}": _success_against_speed(
            folder, table, config.policy_names, paper
        ),
        "Trajectories through one field": _trajectories(folder, config, rows),
        f"Pairs of policies on the same flights, {seeds}": _pairs(config, rows),
        f"Scenarios, {seeds}": _scenarios(folder, config, rows, absent),
        "Flights": _flights(config, rows),
        "Program": _table(["part", "version"], [list(p) for p in folder.program().items()]),
    }
    body = [f"<h1>{title}</h1><p>{_scope(config, rows)}</p>", _warnings(rows, absent, damaged)]
    body += [f"<h2>{heading}</h2>{section}" for heading, section in sections.items() if section]
    head = f'<meta charset="utf-8"><title>{title}</title>{_VIEWPORT}<style>{_STYLE}</style>'
    start = f'<!DOCTYPE html><html lang="en"><head>{head}</head><body>'
    write_text(folder.path / "report.html", start + "\n".join(body) + "</body></html>\n")


class _Html(str):
    """A cell that is HTML already."""


def _table(header: list[str], rows: list[list[Any]]) -> str:
    def line(tag: str, cells: list[Any]) -> str:
        text = (cell if isinstance(cell, _Html) else escape(str(cell)) for cell in cells)
        return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in text) + "</tr>"

    body = "".join(line("td", row) for row in rows)
    return f"<table><thead>{line('th', header)}</thead><tbody>{body}</tbody></table>"


def _image(png: bytes, alt: str) -> str:
    encoded = base64.b64encode(png).decode()
    return f'<img src="data:image/png;base64,{encoded}" alt="{escape(alt)}">'


def _note(text: str) -> str:
    return f'<p class="note">{text}</p>'


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "–"


def _interval(row: Row, kind: str) -> _Html:
    lower, upper = row[f"{kind}_lower"], row[f"{kind}_upper"]
    return _Html(f"<span class=note>[{lower:.0%}, {upper:.0%}]</span>")


def _rate(row: Row) -> _Html:
    if not row["flights"]:
        return _Html("not run")
    return _Html(f"{row['successes'] / row['flights']:.0%} {_interval(row, 'wilson')}")


def _success_cells(row: Row) -> list[str]:
    passed = f"{row['scenarios_passed']}/{row['scenarios']}"
    return [_rate(row), _interval(row, "cluster"), passed]


_SUCCESS = ["success", "new scenarios", "scenarios passed"]


def _scope(config: StudyConfig, rows: list[Row]) -> str:
    speeds = ", ".join(f"{speed:g}" for speed in config.speeds)
    return (
        f"{len(rows)} flights: {len(config.scenarios)} scenarios, {len(config.policies)} policies, "
        f"{describe_seeds(config.split, config.seeds)}, nominal speeds {speeds} m/s. A flight "
        "succeeds if it reaches the goal and its clearance at the vehicle's radius is never "
        "negative. Brackets are 95 % intervals: Wilson's, for these scenarios with new seeds, and "
        "under “new scenarios” those of a bootstrap over scenarios, for others of the same kinds."
    )


def _warnings(rows: list[Row], absent: dict[str, str], damaged: list[str]) -> str:
    lines = [
        f"<b>{escape(name)} was not run</b> and does not count: {escape(reason)}"
        for name, reason in absent.items()
    ]
    lines += [f"{escape(problem)}; the flight was flown again" for problem in damaged]
    lines += [
        f"{escape(row['id'])}, {row['outcome']}, counts as a failure: {escape(row['reason'])}"
        for row in rows
        if "reason" in row
    ]
    return "".join(f'<p class="warn">{line}</p>' for line in lines)


_MEANS = {
    "min. clearance [m]": ("min_clearance_m", "+z.2f"),
    "velocity [m/s]": ("mean_speed_m_s", ".2f"),
    "path excess": ("path_excess", ".1%"),
    "jerk [m/s³]": ("jerk_m_s3", ".1f"),
    "smoothness": ("smoothness", ".1f"),
}


def _policies(table: list[Row]) -> str:
    outcomes = [outcome.replace("_", " ") for outcome in FAILURES]
    header = ["policy", "speed [m/s]", "flights", *_SUCCESS, *outcomes, "not run", *_MEANS]
    rows = [
        [row["policy"], f"{row['speed']:g}", row["flights"], *_success_cells(row)]
        + [row[outcome] for outcome in (*FAILURES, "not_run")]
        + [_number(row[name], form) for name, form in _MEANS.values()]
        for row in table
    ]
    return _table(header, rows)


def _timing(config: StudyConfig, rows: list[Row], timings: list[Row]) -> str:
    header = ["policy", "decision [ms]", "render [ms]", "real-time factor"]
    names = "policy_ms", "render_ms", "real_time_factor"
    lines = []
    for policy in config.policy_names:
        times = [t for r, t in zip(rows, timings, strict=True) if r["policy"] == policy]
        lines.append([policy, *(_number(mean_column(times, name), ".1f") for name in names)])
    return "<p>Mean times, of this machine and its load:</p>" + _table(header, lines)


def _paper(table: list[Row], paper: dict[str, PaperRow]) -> str:
    if not paper:
        return ""
    header = ["policy", "method in the paper", "success, paper", *_SUCCESS]
    header += ["clearance, paper [m]", "here [m]", "velocity, paper [m/s]", "here [m/s]"]
    rows = []
    for row in table:
        if row["policy"] not in paper:
            continue
        theirs = paper[row["policy"]]
        name = f"{row['policy']} at {row['speed']:g} m/s"
        rate = f"{theirs.successes}/{PAPER_FLIGHTS} ({theirs.successes / PAPER_FLIGHTS:.0%})"
        cells = [name, theirs.method, rate, *_success_cells(row)]
        for metric, form in (("min_clearance_m", "+z.2f"), ("mean_speed_m_s", ".2f")):
            cells += [f"{getattr(theirs, metric):{form}}", _number(row[metric], form)]
        rows.append(cells)
    return _table(header, rows) + _note(
        "The paper flew one flight in each of its own 17 scenarios, in Isaac Sim; the scenarios "
        "here are others of the same kinds, passed if most flights succeed. The paper's policies "
        "were trained in reconstructions of TartanAir. The weights that ship were trained in the "
        f"generators of {', '.join(IN_DISTRIBUTION)}: these scenarios are in their training "
        "distribution, with other seeds; the others are not."
    )


def external_section(table: list[Row]) -> str:
    """Formats the external table in HTML; empty if it is."""
    if not table:
        return ""
    header = ["scenario", "policy", "speed [m/s]", "velocity [m/s]", "success"]
    lines = []
    for row in table:
        speed = "published" if row["speed"] is None else f"{row['speed']:g}"
        rate = _Html(f"{row['successes']}/{row['flights']} {_interval(row, 'wilson')}")
        velocity = _number(row["mean_speed_m_s"], ".2f")
        lines.append([row["scenario"], row["policy"], speed, velocity, rate])
    return _table(header, lines) + _note(escape(SOURCES))


def _pairs(config: StudyConfig, rows: list[Row]) -> str:
    lines = []
    for pair in compare(rows, config):
        names = f"{pair.first} and {pair.second}"
        p_values = (f"{p:.3f}" if p >= 0.001 else f"{p:.0e}" for p in pair[-2:])
        lines.append([names, f"{pair.speed:g}", pair.only_first, pair.only_second, *p_values])
    if not lines:
        return "<p>One policy: nothing to compare.</p>"
    header = ["policies", "speed [m/s]", "only the first succeeds", "only the second"]
    header += ["p, these scenarios", "p, new scenarios"]
    return _table(header, lines) + _note(
        "Exact McNemar tests over flights, for these scenarios with new seeds (sign-flip tests "
        "over worlds if flights share them), and sign-flip permutation tests over scenarios, for "
        "others of the same kinds. Both are corrected by "
        f"Holm for all pairs (here {len(lines)})."
    )


def _scenarios(
    folder: StudyFolder, config: StudyConfig, rows: list[Row], absent: dict[str, str]
) -> str:
    columns = [(policy, speed) for policy in config.policy_names for speed in config.speeds]
    header = [_Html(f"{escape(policy)}<br>{speed:g} m/s") for policy, speed in columns]
    lines, single = [], []
    for name in dict.fromkeys(spec.scenario for spec in config.rollouts()):
        cells = [
            _rate(success_summary(select(rows, scenario=name, policy=policy, speed=speed)))
            for policy, speed in columns
        ]
        lines.append([name + (" (not run)" if name in absent else ""), *cells])
        if name not in absent and isinstance(kept_scenario(folder, name).world, SceneSource):
            single.append(escape(name))
    note = _note(
        f"Each of {', '.join(single)} is one environment: other seeds draw other starts and goals "
        "in it (and other inserted solids), no other environment. Test seeds do not make it unseen."
    )
    return _table(["scenario", *header], lines) + (note if single else "")


def _flights(config: StudyConfig, rows: list[Row]) -> str:
    imports = {
        each.label: f"--import {each.policy.partition(':')[0]} "
        for each in config.variants
        if ":" in each.policy
    }
    header = ["flight", "outcome", "time [s]", "min. clearance [m]", "velocity [m/s]", "replay"]
    columns = {"flight_time_s": ".1f", "min_clearance_m": "+z.2f", "mean_speed_m_s": ".2f"}
    sections = [
        "<p>The commands run in the folder that holds this report; each writes the page that its "
        "flight links to.</p>"
    ]
    for name in dict.fromkeys(row["scenario"] for row in rows):
        lines = [
            [_Html(f'<a href="replays/{id}/flight.html">{id}</a>'), row["outcome"]]
            + [_number(row.get(column, math.nan), form) for column, form in columns.items()]
            + [_Html(f"<code>splatpilot {words}replay . {id} --meshcat</code>")]
            for row in select(rows, scenario=name)
            for id, words in [(escape(row["id"]), imports.get(row["policy"], ""))]
        ]
        summary = f"<summary>{escape(name)}: {len(lines)} flights</summary>"
        sections.append(f"<details>{summary}{_table(header, lines)}</details>")
    return "".join(sections)


def _success_against_speed(
    folder: StudyFolder, table: list[Row], policies: list[str], paper: dict[str, PaperRow]
) -> str:
    """Draws Fig. 5 as `success_against_speed.png`: success rate with its 95 % interval against mean
    velocity, a line for each policy, with the paper's points; returns its HTML."""
    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    axes = figure.subplots()
    for policy, color, marker in zip(policies, cycle(_COLORS), cycle(_MARKERS), strict=False):
        rows = [row for row in table if row["policy"] == policy and row["flights"]]
        rows.sort(key=lambda row: row["speed"])
        names = "mean_speed_m_s", "success_rate", "wilson_lower", "wilson_upper"
        speeds, rates, lower, upper = (np.array([row[name] for row in rows]) for name in names)
        errors = 100 * np.maximum([rates - lower, upper - rates], 0.0)
        style = {"color": color, "marker": marker, "capsize": 3}
        axes.errorbar(speeds, 100 * rates, yerr=errors, label=policy, **style)
        if policy in paper:
            theirs = paper[policy]
            rate = 100 * theirs.successes / PAPER_FLIGHTS
            style = {"mfc": "none", "mec": color, "ms": 10, "label": f"{theirs.method} (paper)"}
            axes.plot(theirs.mean_speed_m_s, rate, marker, **style)
    axes.set(xlabel="mean flight velocity [m/s]", ylabel="success rate [%]", ylim=(-3, 103))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    png = write_png(figure, folder.path / "success_against_speed.png")
    return _image(png, "Success rate against velocity")


def _trajectories(folder: StudyFolder, config: StudyConfig, rows: list[Row]) -> str:
    """Draws Fig. 6, flights through one field, as `trajectories.png`; returns its HTML."""
    spec = _telling_flight(rows)
    scenario = sample_scenario(next(kept_flights(folder, [spec]))[1])
    world = make_world(scenario.world, scenario.seed)
    field, p_WG = world.distance_field, goal_position(scenario, world)
    extent = field.upper_W - field.lower_W
    legend_rows = math.ceil(len(config.policies) / _LEGEND_COLUMNS)
    height = float(np.clip(9.0 * extent[1] / extent[0], 2.5, 9.0)) + 0.8 + 0.25 * legend_rows
    figure = Figure(figsize=(9.0, height), layout="constrained")
    axes = figure.subplots()
    x, y = (
        np.arange(low + _SPACING / 2, high, _SPACING)
        for low, high in zip(field.lower_W[:2], field.upper_W[:2], strict=True)
    )
    points = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), p_WG[2])], axis=-1)
    distance = np.minimum(np.nan_to_num(field.distance(points), nan=np.inf), 10.0)
    levels = [-1e3, 0.0, scenario.vehicle.radius]
    axes.contourf(x, y, distance, levels=levels, colors=[_OBSTACLE, _BLOCKED])
    p_WS = world.p_WS
    for policy, color in zip(config.policy_names, cycle(_COLORS), strict=False):
        row, arrays = folder.read(spec._replace(policy=policy))
        if not arrays:
            continue
        p_WB = QuadrotorState.of(arrays["states"]).p_WB
        p_WS = p_WB[0]
        label = f"{policy}: {row['outcome']}"
        axes.plot(p_WB[:, 0], p_WB[:, 1], color=color, lw=1.8, label=label)
        if row["outcome"] != "goal":
            axes.plot(*p_WB[-1, :2], "X", color=color, ms=10, mec="white", zorder=5)
    axes.plot(*p_WS[:2], "o", color="black", ms=7, zorder=5)
    axes.plot(*p_WG[:2], "*", color="black", ms=13, zorder=5)
    title = f"{spec.scenario}, seed {spec.seed}, {spec.speed:g} m/s"
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title, aspect="equal")
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    if axes.get_legend_handles_labels()[0]:
        figure.legend(frameon=False, loc="outside lower center", ncols=_LEGEND_COLUMNS)
    return _image(write_png(figure, folder.path / "trajectories.png"), title) + _note(
        "Dark: obstacles at the height of the goal, from the distance field; light: where the "
        "vehicle's center would collide."
    )


def _telling_flight(rows: list[Row]) -> RolloutSpec:
    """Returns a flight of the field whose flights differ most in success."""
    fields: dict[tuple, list[Row]] = {}
    for row in rows:
        fields.setdefault((row["scenario"], row["speed"], row["seed"]), []).append(row)

    def variety(flown: list[Row]) -> tuple[int, int, float]:
        wins = sum(row["success"] for row in flown)
        return min(wins, len(flown) - wins), wins, sum(r.get("path_length_m", 0.0) for r in flown)

    row = max(fields.values(), key=variety)[0]
    return RolloutSpec(*(row[name] for name in RolloutSpec._fields))
