"""The pictures of a study."""

import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from splatpilot.analysis.benchmark.tables import PAPER_FLIGHTS, PaperRow
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.files import written_atomically
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
