"""The report of a study: one HTML file that needs nothing else."""

import math
from html import escape
from typing import Any

from splatpilot.analysis.benchmark import html_page
from splatpilot.analysis.benchmark.external import external_section, external_table
from splatpilot.analysis.benchmark.figures import (
    draw_success_against_speed,
    save_png,
)
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.study_inputs import kept_scenario
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
from splatpilot.analysis.benchmark.trajectories import trajectories_section
from splatpilot.diagrams.worlds.scene import SceneSource
from splatpilot.systems.files import written_atomically
from splatpilot.systems.seeds import SPLIT_NAMES, describe_seeds

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
