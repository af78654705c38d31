"""Self-contained HTML pages: a scene, a replayed flight, and a running flight."""

import base64
import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import MovingSpheres
from splatpilot.systems.common.files import write_text
from splatpilot.systems.common.validation import require
from splatpilot.systems.policies.hypotheses import Hypotheses, num_hypotheses_in
from splatpilot.systems.splats.background import Background, EnvironmentMap
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.state import QuadrotorState
from splatpilot.systems.visualization.meshcat_drawing import (
    UNKNOWN_GRAY,
    distance_colors,
    encode_jpeg,
)
from splatpilot.systems.visualization.video import colorize_depth

_COVARIANCE_SCALE = 256.0
"""Scales covariances of 1 mm to 16 m to the range of half floats."""


def pack_gaussians(scene: GaussianScene) -> NDArray[np.uint32]:
    """Packs N Gaussians for the page's shader into (N, 8) words of 32 bits: the center as three
    floats [m]; RGB of degree 0 and opacity as bytes, lowest first; the covariance's xx, xy, xz, yy,
    yz, zz as half floats [m^2 / 256], lowest first; and 0."""
    words = np.zeros((len(scene.means), 8), np.uint32)
    words[:, :3] = scene.means.view(np.uint32)
    shades = np.column_stack([scene.base_colors, scene.opacities])
    words[:, 3] = np.round(255 * shades).astype(np.uint8).view(np.uint32)[:, 0]
    covariances = _COVARIANCE_SCALE * scene.covariances
    # Larger ones are scaled down as a whole, to ellipsoids of the same shape.
    largest = np.abs(covariances).max(axis=(1, 2), keepdims=True)
    covariances *= np.minimum(1, np.finfo(np.float16).max / np.maximum(largest, 1e-30))
    halves = covariances[(slice(None), *np.triu_indices(3))]
    words[:, 4:7] = np.ascontiguousarray(halves, np.float16).view(np.uint32)
    return words


_VIEWPORT = '<meta name="viewport" content="width=device-width, initial-scale=1">'


def splat_page(
    meshcat_page: str,
    title: str,
    gaussians: GaussianScene,
    background: Background,
    data: dict[str, Any],
    scripts: Sequence[str],
    start: str,
) -> str:
    """Makes a self-contained HTML page of a scene.

    Args:
        meshcat_page: `Meshcat.StaticHtml()`.
        title: name of the environment, `name` in the page's data, which is as for JSON.
        scripts: names of files in `page`, in the order of their dependencies.
        start: JavaScript of `splats` and `data` that runs last.
    """
    sky = ""
    if isinstance(background, EnvironmentMap):
        # The page's columns run against the azimuth.
        mirrored = EnvironmentMap(background.texels[:, ::-1])
        sky = base64.b64encode(mirrored.png()).decode()
    sources = [_source(name) for name in ("splats.js", *scripts, "page.js")]
    content = json.dumps({"name": title, **data}, allow_nan=False).encode()
    sources.append(f"openPage().then(({{splats, data}}) => {{ {start} }});")
    added = (
        f"<style>{_source('page.css')}</style>"
        f'<script type="text/plain" id="gaussians">'
        f"{compressed(pack_gaussians(gaussians).tobytes())}</script>"
        f'<script type="text/plain" id="sky">{sky}</script>'
        f'<script type="text/plain" id="data">{compressed(content)}</script>'
    ) + "".join(f"<script>{source}</script>" for source in sources)
    meshcat_page = meshcat_page.replace(
        "<title>Drake MeshCat</title>", f"<title>{escape(title)}</title>{_VIEWPORT}", 1
    )
    head, body, tail = meshcat_page.rpartition("</body>")
    return head + added + body + tail


class HtmlPage:
    """A self-contained HTML page; notebooks show it inline."""

    def __init__(self, html: str):
        self.html = html

    def _repr_html_(self) -> str:
        style = "width: 100%; height: 600px; border: 0"
        return f'<iframe srcdoc="{escape(self.html)}" style="{style}"></iframe>'

    def save(self, path: str | Path) -> None:
        """Writes the page atomically."""
        write_text(path, self.html)


def compressed(data: bytes) -> str:
    """Compresses bytes to text for `inflate` of `page/page.js`, deterministically."""
    return base64.b64encode(gzip.compress(data, 6, mtime=0)).decode()


def rounded(values: NDArray[np.floating]) -> list:
    """Rounds numbers to 0.1 mm, as nested lists; None stands for those that are not finite."""
    numbers = np.round(values, 4)
    return np.where(np.isfinite(numbers), numbers, np.array(None)).tolist()


def jpeg(image: NDArray[np.uint8]) -> str:
    """Encodes an image (H, W, 3), BGR, for a page."""
    return base64.b64encode(encode_jpeg(image[..., ::-1])).decode()


def _source(name: str) -> str:
    return (resources.files(__package__) / "page" / name).read_text()


_MAX_VOXELS = 3e6
_SCRIPTS = "pick.js", "ruler.js", "distance_slice.js", "capture_cameras.js", "scene_view.js"
_MAX_DISTANCE = 2.0  # [m] from which on all distances have one color
_MAX_DISTANCE_VOXELS = 40  # the same in voxels, if the unit of length is unknown


@dataclass(frozen=True, eq=False)
class CapturedImages:
    """Some of the images of a capture."""

    X_WCs: Sequence[RigidTransform]
    names: Sequence[str]
    images: Sequence[NDArray[np.uint8]]  # (H, W, 3) each, BGR, reduced in size
    K: NDArray[np.float64]  # (3, 3) [px] of the camera at full size
    width: int  # [px] at full size
    height: int  # [px] at full size

    @property
    def p_WCs(self) -> NDArray[np.float64]:
        """(N, 3) [m], positions of the cameras."""
        return np.array([X_WC.translation() for X_WC in self.X_WCs])


@dataclass(frozen=True, eq=False)
class ViewerScene:
    """A scene for the page `scene_page`; lengths are in meters if `metric`."""

    name: str
    gaussians: GaussianScene
    background: Background
    lower_W: NDArray[np.float64]  # (3,) [m], corners of the bounds
    upper_W: NDArray[np.float64]  # (3,) [m]
    height: float  # [m] above which nothing is shown at first
    field: Esdf | None = None
    ends: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None  # (3,) [m], start and goal
    images: CapturedImages | None = None
    num_frontier: int = 0  # last Gaussians, which close unseen space
    beyond: bool = True  # shows Gaussians beyond the bounds at first
    metric: bool = True
    legend: Sequence[tuple[str, str]] = ()  # CSS color and name of drawn objects
    notes: Sequence[str] = ()
    scale_command: str = ""  # without its two points and their distance

    @property
    def max_distance(self) -> float:
        """[m] to surfaces, from which on all distances have one color."""
        if self.metric or self.field is None:
            return _MAX_DISTANCE
        return _MAX_DISTANCE_VOXELS * self.field.voxel_size


def scene_page(meshcat_page: str, scene: ViewerScene) -> str:
    """Makes a self-contained HTML page of a scene; `meshcat_page` is `Meshcat.StaticHtml()`."""
    size = scene.upper_W - scene.lower_W
    unit = "m" if scene.metric else "units"
    lengths = " x ".join(f"{length:.3g}" for length in size)
    lengths += " m" if scene.metric else " in units of unknown length"
    field, images = scene.field, scene.images
    data: dict[str, Any] = {
        "size": f"{lengths}, {len(scene.gaussians):,} Gaussians",
        "unit": unit,
        "notes": list(scene.notes),
        "legend": [*scene.legend, *([("#ff9020", "captured from")] if images else [])],
        "lower": rounded(scene.lower_W),
        "upper": rounded(scene.upper_W),
        "height": scene.height,
        # Seen from above across the shorter side.
        "toward": [0.0, -0.8, 1.0] if size[0] >= size[1] else [-0.8, 0.0, 1.0],
        "beyond": scene.beyond,
        "unknown": scene.num_frontier,
        "scale_command": scene.scale_command,
        "grid": field and _grid(field, scene.max_distance),
        "cameras": images and _cameras(images, float(np.linalg.norm(size))),
    }
    start = "SceneView.open(viewer, splats, data).then((view) => { window.view = view; });"
    shown = scene.gaussians, scene.background
    return splat_page(meshcat_page, scene.name, *shown, data, _SCRIPTS, start)


def _grid(field: Esdf, max_distance: float) -> dict[str, Any]:
    """Converts a subsampled grid to bytes: 0 at surfaces, 254 at `max_distance`, 255 if unknown."""
    stride = int(np.ceil(np.cbrt(field.distances.size / _MAX_VOXELS)))
    thin = (slice(stride // 2, None, stride),) * 3
    values = np.round(254 * np.clip(field.distances[thin] / max_distance, 0, 1)).astype(np.uint8)
    values[field.states[thin] == FieldState.UNKNOWN] = 255
    colors = np.append(distance_colors(np.arange(255) / 254), np.full((1, 3), UNKNOWN_GRAY), 0)
    return {
        "shape": list(values.shape),
        "lower": rounded(field.lower_W),
        "voxel_size": stride * field.voxel_size,
        "reach": max_distance,
        "palette": np.round(255 * colors).astype(int).tolist(),
        "values": compressed(values.tobytes(order="F")),
    }


def _cameras(images: CapturedImages, extent: float) -> dict[str, Any]:
    slope_x = 0.5 * images.width / images.K[0, 0]
    slope_y = 0.5 * images.height / images.K[1, 1]
    return {
        "size": 0.012 * extent,
        "slope_x": slope_x,
        "slope_y": slope_y,
        "fov_y": np.degrees(2 * np.arctan(slope_y)),
        "poses": [X_WC.GetAsMatrix4().ravel().tolist() for X_WC in images.X_WCs],
        "names": list(images.names),
        "images": [jpeg(image) for image in images.images],
    }


_COLORS = ("#2f8fe8", "#e8b52e", "#e8432e", "#a05ce0", "#30b870", "#e060b0", "#50c8d0", "#b0b0b0")
_RATE = 30.0  # [Hz], samples of a flight in the page
_SPHERES_PERIOD = 0.1  # [s] between samples of moving spheres


@dataclass(frozen=True, eq=False)
class Frames:
    """Images of the onboard camera from the start on."""

    period: float  # [s]
    color: Sequence[str]  # see `jpeg`
    depth: Sequence[str]  # the same, of `colorize_depth`
    max_depth: float = 20.0  # [m], see `colorize_depth`


@dataclass(frozen=True, eq=False)
class ReplayedFlight:
    """One flight of a page; N samples."""

    name: str
    outcome: str
    times: NDArray[np.float64]  # (N,) [s]
    states: NDArray[np.float64]  # (N, 13), see `QuadrotorState`
    clearances: NDArray[np.float64]  # (N,) [m], NaN where unknown
    hypotheses: NDArray[np.float64]  # (M, size), see `Hypotheses.to_vector`; (0, 0) without
    frames: Frames | None = None


@dataclass(frozen=True, eq=False)
class ReplayView:
    """Environment, vehicle, camera and heights of a page."""

    name: str  # of the environment
    X_BC: RigidTransform  # pose of the onboard camera in the vehicle's body frame
    fov_y: float  # [rad] of the onboard camera
    radius: float  # [m] of the vehicle
    lower: float  # [m] height of the world's floor
    upper: float  # [m] height of its ceiling
    margin: float = 0.2  # [m] clearance below which the vehicle is red
    num_frontier: int = 0  # last Gaussians, which close unseen space


def replay_page(
    meshcat_page: str,
    gaussians: GaussianScene,
    background: Background,
    view: ReplayView,
    flights: Sequence[ReplayedFlight],
    spheres: MovingSpheres | None = None,
) -> str:
    """Makes a self-contained HTML page of flights.

    Args:
        meshcat_page: `Meshcat.StaticHtml()` with static objects, and the vehicle of flight k at
            `/splatpilot/vehicles/k`.
        flights: at least one; the first is selected at first.
        spheres: moving obstacles.
    """
    require(flights, "flights", "at least one", 0)
    duration = max(flight.times[-1] for flight in flights)
    highest = max(QuadrotorState.of(flight.states).p_WB[:, 2].max() for flight in flights)
    data = vars(view) | {
        "X_BC": view.X_BC.GetAsMatrix4().ravel().tolist(),
        "fov_y": np.degrees(view.fov_y),
        "unknown": view.num_frontier,
        "depth_scale": _depth_scale(max(f.frames.max_depth if f.frames else 1 for f in flights)),
        "cut": min(view.upper, highest + 2 * view.radius),
        "spheres": spheres and _sphere_tracks(spheres, duration),
        "flights": [
            _flight_data(flight, _COLORS[k % len(_COLORS)]) for k, flight in enumerate(flights)
        ],
    }
    return splat_page(
        meshcat_page,
        view.name,
        gaussians,
        background,
        data,
        ("plot.js", "replay_flight.js", "replay.js"),
        "window.replay = new Replay(viewer, splats, data);",
    )


def _depth_scale(max_depth: float) -> dict[str, Any]:
    """Returns colors evenly spaced in depth [m], and texts."""
    colors = colorize_depth(np.linspace(0.5, max_depth, 33)[None], max_depth)[0]
    middle = 0.5 * (0.5 + max_depth)
    return {
        "colors": [f"rgb({r}, {g}, {b})" for b, g, r in colors.tolist()],
        "texts": [f"{depth:.3g} m" for depth in (0.5, middle, max_depth)],
    }


def _flight_data(flight: ReplayedFlight, color: str) -> dict[str, Any]:
    # The samples nearest to the page's rate, and the last, at which a flight ends.
    samples = np.arange(flight.times[0], flight.times[-1], 1 / _RATE)
    rows = np.unique(np.append(np.searchsorted(flight.times, samples), len(flight.times) - 1))
    state = QuadrotorState.of(flight.states[rows])
    return {
        "name": flight.name,
        "outcome": flight.outcome,
        "color": color,
        "times": rounded(flight.times[rows]),
        "p_WB": rounded(state.p_WB),
        "q_WB": rounded(state.q_WB),
        "speeds": rounded(np.linalg.norm(state.v_WB, axis=1)),
        "clearances": rounded(flight.clearances[rows]),
        "plans": _plans(flight.hypotheses),
        "frames": flight.frames and vars(flight.frames),
    }


def _sphere_tracks(spheres: MovingSpheres, duration: float) -> dict[str, Any]:
    times = np.arange(0.0, duration + 2 * _SPHERES_PERIOD, _SPHERES_PERIOD)
    centers = np.array([spheres.centers(time) for time in times])
    return {
        "period": _SPHERES_PERIOD,
        "radii": rounded(spheres.radii),
        "centers": rounded(np.round(centers, 3)),
    }


def _plans(vectors: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Converts the plans to W, in the order of their times, each once."""
    plans: dict[float, dict[str, Any]] = {}
    for vector in vectors:
        plan = Hypotheses.from_vector(vector, num_hypotheses_in(len(vector)))
        if plan is not None:
            plans[plan.plan_time] = {
                "time": plan.plan_time,
                "p_WB": rounded(plan.X_WB.translation()),
                "waypoints_W": rounded(plan.waypoints_W),
                "costs": rounded(plan.costs),
            }
    return list(plans.values())


def live_page(
    meshcat: Meshcat,
    gaussians: GaussianScene,
    background: Background,
    view: ReplayView,
    cut: float,
) -> str:
    """Makes an HTML page with the Gaussians that receives the rest from `meshcat`, on this machine.

    It shows the last `send_picture` in its panel, and hides the points at `/splatpilot/scene` and,
    at first, Gaussians above the height `cut` [m].
    """
    fov_y, heights = float(np.degrees(view.fov_y)), {"lower": view.lower, "upper": view.upper}
    return splat_page(
        meshcat.StaticHtml(),
        view.name,
        gaussians,
        background,
        {"url": meshcat.ws_url(), "cut": cut, "fov_y": fov_y, **heights},
        ("live.js",),
        "window.views = showLive(splats, data); window.live = splats;",
    )
