"""The external table: policies in others' scenarios, beside what others published about them."""

from html import escape
from typing import Any, NamedTuple

from splatpilot.analysis.benchmark import html_page
from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.tables import mean_of, select, wilson_interval


class Published(NamedTuple):
    """Somebody else's flights through courses of the same generator."""

    method: str
    mean_speed_m_s: float
    successes: int  # at the end without a hit
    flights: int


PUBLISHED: dict[str, tuple[Published, ...]] = {
    "dodgedrone_easy": (),
    "dodgedrone_medium": (
        Published("NMPC, knows the obstacles [1]", 2.9, 187, 303),
        Published("PPO, knows the obstacles [1]", 2.8, 130, 303),
    ),
    "dodgedrone_hard": (
        Published("NMPC, knows the obstacles [1]", 2.9, 35, 303),
        Published("PPO, knows the obstacles [1]", 2.8, 22, 303),
        Published("FlightEvo, sees depth [2]", 3.0, 0, 20),
    ),
}
"""By others' scenarios."""

DODGEDRONE = tuple(PUBLISHED)
"""The levels of the DodgeDrone challenge."""

DODGEDRONE_SPEEDS = 2.0, 3.0, 5.0, 7.0
"""[m/s], at which they are flown."""

SOURCES = (
    "[1] github.com/arseniid/agile_flight, final_evaluation: courses 0 to 100 of the challenge, "
    "three flights each, in at most 70 s; NMPC with a horizon of 12, PPO 39. "
    "[2] github.com/ykeuter/flightevo, analysis, the winner of the challenge by vision: member 4, "
    "courses 20 to 39; 28.4 m on average until the first hit. "
    "Brackets are Wilson's 95 % intervals, of this scenario with other courses. "
    "Their vehicles are hit when their centre is in a ball, ours when its radius of 0.354 m is."
)


def external_table(rows: list[dict[str, Any]], config: StudyConfig) -> list[dict[str, Any]]:
    """For each of others' scenarios that a study flies as it is, a row for each figure that was
    published, and then one for each of the study's policies and speeds."""
    names = [] if config.overrides else [name for name in config.scenarios if name in PUBLISHED]
    table = []
    for name in names:
        for method, mean_speed, successes, flights in PUBLISHED[name]:
            table.append(_row(name, method, None, mean_speed, successes, flights))
        for policy in config.policy_names:
            for speed in config.speeds:
                flown = select(rows, scenario=name, policy=policy, speed=speed)
                successes = sum(row["success"] for row in flown)
                mean_speed = mean_of(flown, "mean_speed_m_s")
                table.append(_row(name, policy, speed, mean_speed, successes, len(flown)))
    return table


def _row(
    scenario: str,
    policy: str,
    speed: float | None,
    mean_speed: float,
    successes: int,
    flights: int,
) -> dict[str, Any]:
    interval = wilson_interval(successes, flights)
    return {
        "scenario": scenario,
        "policy": policy,
        "speed": speed,
        "mean_speed_m_s": mean_speed,
        "successes": successes,
        "flights": flights,
        "wilson_lower": interval.lower,
        "wilson_upper": interval.upper,
    }


def format_external(table: list[dict[str, Any]]) -> str:
    """The external table for a terminal."""
    lines = [f"{'scenario':<20}{'policy':<32}{'speed':>6}{'velocity':>10}{'success':>10}"]
    for row in table:
        speed = "-" if row["speed"] is None else f"{row['speed']:g}"
        lines.append(
            f"{row['scenario']:<20}{row['policy']:<32}{speed:>6}{row['mean_speed_m_s']:>6.2f} m/s"
            f"{row['successes']:>6}/{row['flights']}"
        )
    return "\n".join([*lines, SOURCES])


def external_section(table: list[dict[str, Any]], seeds: str) -> str:
    """Formats the external table in HTML, with its `seeds` in the heading; empty if it is."""
    if not table:
        return ""
    header = ["scenario", "policy", "speed [m/s]", "velocity [m/s]", "success"]
    rows = [
        [
            escape(row["scenario"]),
            escape(row["policy"]),
            "published" if row["speed"] is None else f"{row['speed']:g}",
            html_page.number(row["mean_speed_m_s"], ".2f"),
            f"{row['successes']}/{row['flights']} <span class=note>[{row['wilson_lower']:.0%}, "
            f"{row['wilson_upper']:.0%}]</span>",
        ]
        for row in table
    ]
    note = f'<p class="note">{escape(SOURCES)}</p>'
    return f"<h2>Beside published figures, {seeds}</h2>" + html_page.table(header, rows) + note
