"""The flights of all policies through one field, drawn together."""

from typing import Any

from splatpilot.analysis.benchmark import html_page
from splatpilot.analysis.benchmark.figures import draw_trajectories, save_png
from splatpilot.analysis.benchmark.study import RolloutSpec, StudyConfig
from splatpilot.analysis.benchmark.study_folder import StudyFolder
from splatpilot.analysis.benchmark.study_inputs import kept_flights
from splatpilot.diagrams.pilot import goal_of
from splatpilot.diagrams.worlds.make_world import make_world
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState


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
        world, flights, p_WS, goal_of(scenario, world), config.policy_names, title
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
