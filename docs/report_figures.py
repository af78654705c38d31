"""Draws the figures of the report from the rows of results; `results.py write` writes them."""

import io
import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

Row = dict[str, Any]

_HERE: Any = {"color": "tab:blue", "marker": "o"}
_PAPER: Any = {"color": "tab:orange", "marker": "D"}
_MARKERS = "os^vDPX*<>dph"
_STYLE: Any = {"font.size": 8, "axes.grid": True, "grid.alpha": 0.3, "svg.hashsalt": "splatpilot"}


def _axes(
    height: float, columns: int = 1, width: float = 7.5, **options: Any
) -> tuple[Figure, list[Axes]]:
    """Makes a figure of height and width [in], with axes next to each other."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(figure.subplots(1, columns, squeeze=False, **options)[0])


def svg(figure: Figure) -> str:
    """Returns a figure as SVG, which describes the plotted data and is deterministic."""
    text = io.StringIO()
    with rc_context(_STYLE):
        figure.savefig(text, format="svg", metadata={"Date": None, "Description": plotted(figure)})
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines()) + "\n"


def plotted(figure: Figure) -> str:
    """Returns labels and plotted data of a figure as JSON, to four digits."""

    def digits(values: Any) -> Any:
        return [float(f"{x:.4g}") for x in np.ravel(np.asarray(values, float))]

    axes = [
        {
            "labels": [each.get_xlabel(), each.get_ylabel(), *_names(each)],
            "lines": [[line.get_label(), digits(line.get_xydata())] for line in each.lines],
            "images": [digits(image.get_array()) for image in each.images],
            "texts": [text.get_text() for text in each.texts],
        }
        for each in figure.axes
    ]
    return json.dumps(axes)


def _names(axes: Axes) -> list[str]:
    """Returns the names of rows and columns."""
    formatters = (axis.get_major_formatter() for axis in (axes.xaxis, axes.yaxis))
    return [str(name) for each in formatters for name in getattr(each, "seq", ())]


def _name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Names the rows 0, 1, ... from top to bottom."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)


def ablation(rows: Sequence[Row]) -> Figure:
    """Draws image quality and depth error of each arm."""
    figure, axes = _axes(2.8, 2, sharey=True)
    here = [not row["arm"].startswith("paper") for row in rows]
    panels = ("psnr_db", "PSNR [dB]"), ("depth_mae_m", "depth MAE [m]")
    for each, (column, title) in zip(axes, panels, strict=True):
        for source, style, is_here in (("here", _HERE, True), ("paper", _PAPER, False)):
            found = [k for k, mine in enumerate(here) if mine == is_here]
            each.plot([rows[k][column] for k in found], found, ls="", label=source, **style)
        each.set_xlabel(title)
    axes[1].set_xscale("log")
    _name_rows(axes[0], [row["arm"] for row in rows])
    axes[1].legend()
    return figure


def off_path(rows: Sequence[Row]) -> Figure:
    """Draws medians with the percentiles 10 and 90 of errors by the offset from the path."""
    figure, axes = _axes(2.5, 3)
    panels = (
        ("psnr_db", "PSNR [dB]", 1.0),
        ("depth_mae_m", "depth MAE [m]", 1.0),
        ("depth_relative", "relative depth error [%]", 100.0),
    )
    for k, scene in enumerate(dict.fromkeys(row["scene"] for row in rows)):
        these = [row for row in rows if row["scene"] == scene]
        offsets = [row["offset_m"] for row in these]
        for each, (column, title, factor) in zip(axes, panels, strict=True):
            middle, low, high = (
                factor * np.array([row[column + end] for row in these])
                for end in ("", "_low", "_high")
            )
            each.plot(offsets, middle, color=f"C{k}", marker=_MARKERS[k], ms=4, label=scene)
            for x, *limits in zip(offsets, low, high, strict=True):
                each.plot([x, x], limits, color=f"C{k}", alpha=0.5, label="_range")
            each.set(xlabel="offset from the path [m]", ylabel=title)
    axes[0].legend()
    return figure


def twin_policies(rows: Sequence[Row]) -> Figure:
    """Draws each policy's success in scenes against that in meshes."""
    figure, (axes,) = _axes(3.4, width=4.8)
    axes.plot([0, 1], [0, 1], color="0.7", lw=1, label="_equal")
    for k, row in enumerate(rows):
        style: Any = {"marker": _MARKERS[k % len(_MARKERS)], "ls": "", "alpha": 0.7, "ms": 7}
        axes.plot(row["splat"], row["mesh"], label=row["policy"], clip_on=False, **style)
    axes.set(xlabel="success in reconstructed scenes", ylabel="success in the meshes")
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(PercentFormatter(1.0))
    figure.legend(loc="outside right center")
    return figure


def _label(row: Row) -> str:
    return f"{row['policy']}, {row['speed']:g} m/s"


def success(rows: Sequence[Row]) -> Figure:
    """Draws success rates with intervals of flights and of scenarios, next to the paper's."""
    figure, (axes,) = _axes(0.8 + 0.28 * len(rows))
    for k, row in enumerate(rows):
        axes.plot([row["new_low"], row["new_high"]], [k, k], color="tab:blue", lw=1)
        axes.plot([row["low"], row["high"]], [k, k], color="tab:blue", lw=4, alpha=0.4)
        axes.plot(row["rate"], k, ls="", **_HERE)
        if "paper_method" in row:
            y = k + 0.25
            axes.plot([row["paper_low"], row["paper_high"]], [y, y], color="tab:orange", lw=1)
            rate = row["paper_successes"] / row["paper_flights"]
            axes.plot(rate, y, ls="", ms=4, **_PAPER)
    has_paper = any("paper_method" in row for row in rows)
    axes.set_xlabel("success" + ": here (blue) and in the paper (orange)" * has_paper)
    axes.set_xlim(-0.02, 1.02)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    _name_rows(axes, [_label(row) for row in rows])
    return figure


def speed(rows: Sequence[Row]) -> Figure:
    """Draws success rates against mean velocities, next to the paper's."""
    figure, (axes,) = _axes(3.0)
    for k, row in enumerate(rows):
        marker = _MARKERS[k % len(_MARKERS)]
        axes.plot(row["speed_m_s"], row["rate"], marker, color=f"C{k % 10}", label=_label(row))
        if "paper_method" in row:
            rate = row["paper_successes"] / row["paper_flights"]
            options: Any = {"color": f"C{k % 10}", "mfc": "none", "label": "_paper"}
            axes.plot(row["paper_mean_speed_m_s"], rate, marker, **options)
    has_paper = any("paper_method" in row for row in rows)
    axes.set_xlabel("mean velocity [m/s]" + "; hollow: in the paper" * has_paper)
    axes.set(ylabel="success", ylim=(-0.03, 1.03))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    figure.legend(loc="outside right center")
    return figure


def density(rows: Sequence[Row]) -> Figure:
    """Draws success by speed and density of trees as heat maps, one of each policy."""
    policies, speeds, forests = (
        list(dict.fromkeys(row[name] for row in rows)) for name in ("policy", "speed", "scenario")
    )
    figure, axes = _axes(1.0 + 0.3 * len(speeds), len(policies), sharey=True)
    for each, policy in zip(axes, policies, strict=True):
        rates = np.full((len(speeds), len(forests)), np.nan)
        for row in (row for row in rows if row["policy"] == policy):
            k = speeds.index(row["speed"]), forests.index(row["scenario"])
            rates[k] = row["successes"] / row["flights"]
            each.text(k[1], k[0], f"{row['successes']}/{row['flights']}", ha="center", va="center")
        each.imshow(rates, cmap="RdYlGn", vmin=0.0, vmax=1.0, alpha=0.7, aspect="auto")
        names = [name.replace("trees_", "1/") for name in forests]
        each.set_xticks(range(len(forests)), names)
        each.set(title=policy, xlabel="trees per m²")
        each.grid(False)
    _name_rows(axes[0], [f"{speed:g} m/s" for speed in speeds])
    return figure


def gap(rows: Sequence[Row]) -> Figure:
    """Draws success by captured images less that by rendered ones, with intervals."""
    rows = [row for row in rows if row["gap_points"] != ""]
    figure, (axes,) = _axes(2.0)
    axes.axvline(0.0, color="0.5", lw=1)
    for k, row in enumerate(rows):
        axes.plot([row["gap_low"], row["gap_high"]], [k, k], color="tab:blue", lw=1)
        axes.plot(row["gap_points"], k, ls="", **_HERE)
    axes.set_xlabel("success by captured images less that by rendered images [points]")
    _name_rows(axes, [f"{row['policy']}, {row['scene']}" for row in rows])
    return figure


def realism(rows: Sequence[Row]) -> Figure:
    """Draws success by policy and condition as a heat map."""
    conditions = list(dict.fromkeys(row["conditions"] for row in rows))
    policies = list(dict.fromkeys(row["policy"] for row in rows))
    rates = np.full((len(policies), len(conditions)), np.nan)
    figure, (axes,) = _axes(0.8 + 0.28 * len(policies))
    for row in rows:
        k = policies.index(row["policy"]), conditions.index(row["conditions"])
        rates[k] = row["successes"] / row["flights"]
        axes.text(k[1], k[0], f"{row['successes']}/{row['flights']}", ha="center", va="center")
    axes.imshow(rates, cmap="RdYlGn", vmin=0.0, vmax=1.0, alpha=0.7, aspect="auto")
    axes.set_xticks(range(len(conditions)), [name.replace("_", "\n") for name in conditions])
    axes.grid(False)
    _name_rows(axes, policies)
    return figure


FIGURES: dict[Callable[[Sequence[Row]], Figure], str] = {
    ablation: "ablation",
    off_path: "off_path",
    twin_policies: "twin_policies",
    success: "success",
    speed: "success",
    density: "density",
    gap: "gap",
    realism: "realism",
}
"""The results that each figure shows."""


def draw_all(read: Callable[[str], Sequence[Row]]) -> dict[str, Figure]:
    """Draws the figures by name; `read` returns the rows of results."""
    with rc_context(_STYLE):
        return {draw.__name__: draw(read(name)) for draw, name in FIGURES.items()}
