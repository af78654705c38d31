"""A page to look at a place in: its Gaussians, distances, where it was captured from, a ruler."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.splats.background import Background
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.visualization.drawing import UNKNOWN_GREY, distance_colors
from splatpilot.systems.visualization.splat_page import compressed, jpeg, rounded, splat_page

_MAX_VOXELS = 3e6
_SCRIPTS = "pick.js", "ruler.js", "distance_slice.js", "capture_cameras.js", "place_view.js"
_REACH = 2.0  # [m], distance from which on all have one colour
_REACH_UNKNOWN = 40  # [-] the same in voxels, where the unit of length is unknown


@dataclass(frozen=True, eq=False)
class CapturedImages:
    """Some of the images of a capture."""

    X_WCs: Sequence[RigidTransform]
    names: Sequence[str]
    images: Sequence[NDArray[np.uint8]]  # (H, W, 3) each, blue first
    K: NDArray[np.float64]  # (3, 3) [px], of the camera before its images were made small
    width: int  # [px]
    height: int  # [px]

    @property
    def p_WCs(self) -> NDArray[np.float64]:
        """(N, 3) [m], where the cameras were."""
        return np.array([X_WC.translation() for X_WC in self.X_WCs])


@dataclass(frozen=True, eq=False)
class ShownPlace:
    """A place and what is known of it; its lengths are metres unless `metric` is false."""

    name: str
    gaussians: GaussianScene
    background: Background
    lower_W: NDArray[np.float64]  # (3,) [m], corners of the box that is of interest
    upper_W: NDArray[np.float64]  # (3,) [m]
    height: float  # [m], above which nothing is shown at first
    field: Esdf | None = None
    ends: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None  # (3,) [m], start and goal
    images: CapturedImages | None = None
    num_unknown: int = 0  # of the Gaussians, at their end: where nobody looked any further
    beyond: bool = True  # whether Gaussians beyond the bounds are shown at first
    metric: bool = True
    legend: Sequence[tuple[str, str]] = ()  # colours, as in CSS, of what is drawn, and its names
    notes: Sequence[str] = ()  # sentences about the place
    scale_command: str = ""  # to which two points and the length between them need be added

    @property
    def reach(self) -> float:
        """[m], the distance to surfaces from which on all have one colour."""
        if self.metric or self.field is None:
            return _REACH
        return _REACH_UNKNOWN * self.field.voxel_size


def place_page(meshcat_page: str, place: ShownPlace) -> str:
    """
    The HTML of a page that needs nothing else, not even a network.

    Args:
        meshcat_page: `Meshcat.StaticHtml()` with what else is to be seen.
        place: what is shown.
    """
    size = place.upper_W - place.lower_W
    unit = "m" if place.metric else "units"
    data: dict[str, Any] = {
        "name": place.name,
        "size": " x ".join(f"{length:.3g}" for length in size)
        + (" m" if place.metric else " in units of unknown length")
        + f", {len(place.gaussians):,} Gaussians",
        "unit": unit,
        "notes": list(place.notes),
        "legend": [*place.legend, *([("#ff9020", "captured from")] if place.images else [])],
        "lower": rounded(place.lower_W),
        "upper": rounded(place.upper_W),
        "height": place.height,
        # Seen from above across the shorter side.
        "toward": [0.0, -0.8, 1.0] if size[0] >= size[1] else [-0.8, 0.0, 1.0],
        "beyond": place.beyond,
        "unknown": place.num_unknown,
        "scale_command": place.scale_command,
        "grid": place.field and _grid(place.field, place.reach),
        "cameras": place.images and _cameras(place.images, float(np.linalg.norm(size))),
    }
    return splat_page(
        meshcat_page,
        place.gaussians,
        place.background,
        data,
        _SCRIPTS,
        "PlaceView.open(viewer, splats, data).then((view) => { window.view = view; });",
    )


def _grid(field: Esdf, reach: float) -> dict[str, Any]:
    """The distances as bytes, of every so many-th voxel along each axis: 0 at a surface, 254 at
    `reach`, 255 where nobody looked."""
    stride = int(np.ceil(np.cbrt(field.distances.size / _MAX_VOXELS)))
    thin = (slice(stride // 2, None, stride),) * 3
    values = np.round(254 * np.clip(field.distances[thin] / reach, 0, 1)).astype(np.uint8)
    values[field.states[thin] == FieldState.UNKNOWN] = 255
    colors = np.append(distance_colors(np.arange(255) / 254), np.full((1, 3), UNKNOWN_GREY), 0)
    return {
        "shape": list(values.shape),
        "lower": rounded(field.lower_W),
        "voxel_size": stride * field.voxel_size,
        "reach": reach,
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
