"""The external table: policies in published scenarios, with published results."""

from typing import NamedTuple

from splatpilot.analysis.benchmark.study import StudyConfig
from splatpilot.analysis.benchmark.tables import Row, mean_of, select, wilson_interval


class Published(NamedTuple):
    """A published success rate."""

    method: str
    mean_speed_m_s: float
    successes: int  # reached the end without a hit
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
"""By scenario."""

DODGEDRONE = tuple(PUBLISHED)
"""The levels of the DodgeDrone challenge."""

DODGEDRONE_SPEEDS = 2.0, 3.0, 5.0, 7.0
"""[m/s], of their flights."""

SOURCES = (
    "[1] github.com/arseniid/agile_flight, final_evaluation: courses 0 to 100 of the challenge, "
    "three flights each, in at most 70 s; NMPC with a horizon of 12, PPO 39. "
    "[2] github.com/ykeuter/flightevo, analysis, the winner of the challenge by vision: member 4, "
    "courses 20 to 39; 28.4 m on average until the first hit. "
    "Brackets are Wilson's 95 % intervals, of this scenario with other courses. Their vehicles "
    "collide if their center is in a sphere, ours if a sphere of 0.354 m about its center does."
)


def external_table(rows: list[Row], config: StudyConfig) -> list[Row]:
    """Returns, for each published scenario that a study flies unchanged, a row for each published
    result, and then for each of the study's policies and speeds."""
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
) -> Row:
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


def format_external(table: list[Row]) -> str:
    """Formats the external table for a terminal."""
    lines = [f"{'scenario':<20}{'policy':<32}{'speed':>6}{'velocity':>10}{'success':>10}"]
    for row in table:
        speed = "-" if row["speed"] is None else f"{row['speed']:g}"
        lines.append(
            f"{row['scenario']:<20}{row['policy']:<32}{speed:>6}{row['mean_speed_m_s']:>6.2f} m/s"
            f"{row['successes']:>6}/{row['flights']}"
        )
    return "\n".join([*lines, SOURCES])
