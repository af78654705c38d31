"""A place served by viser, which draws Gaussians in browsers."""

import threading
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from splatpilot.systems.common.extras import import_extra
from splatpilot.systems.splats.background import mean_color
from splatpilot.systems.visualization.meshcat_drawing import (
    BALL,
    GOAL_COLOR,
    START_COLOR,
    box_edges,
    distance_slice,
)
from splatpilot.systems.visualization.pages import CapturedImages, ShownPlace

if TYPE_CHECKING:
    import viser

_LARGEST = 200.0  # [m], standard deviation whose square viser's halves can hold


def serve_place(
    place: ShownPlace, host: str = "127.0.0.1", port: int = 8080
) -> "viser.ViserServer":
    """
    Serves what `place_page` shows, but for the ruler, until the server that is returned is stopped.

    Every kind of thing is a node of viser's scene tree and can be hidden there: `gaussians` up to
    the height below which places open, those `above` it, `beyond` the bounds and `unknown`, where
    nobody looked; the `bounds`; `start` and `goal`; `cameras`, of which a click takes the view; and
    `distances`, a slice of the distance field at the height of a slider.

    Args:
        place: what is shown.
        host: address at which to listen.
        port: the first to try; the server knows which one it is.

    Raises:
        ModuleNotFoundError: if viser is not installed; the message says what to install.
    """
    viser = import_extra("viser", "viser")
    server = viser.ViserServer(host, port, label=place.name, verbose=False)
    server.scene.set_up_direction("+z")
    background = np.round(255 * np.clip(mean_color(place.background), 0, 1)).astype(np.uint8)
    server.scene.set_background_image(np.full((1, 1, 3), background))
    center, size = (place.lower_W + place.upper_W) / 2, place.upper_W - place.lower_W
    server.initial_camera.look_at = center
    server.initial_camera.position = center + np.linalg.norm(size) * np.array([0, -0.5, 0.7])
    _add_gaussians(server, place)
    edges = box_edges(place.lower_W, place.upper_W)
    server.scene.add_line_segments("/bounds", edges, (255, 255, 255), thickness=0.02)
    for name, p_W, color in zip(
        ("start", "goal"), place.ends or (), (START_COLOR, GOAL_COLOR), strict=False
    ):
        rgb = color.r(), color.g(), color.b()
        server.scene.add_icosphere(f"/{name}", BALL, rgb, opacity=color.a(), position=p_W)
    if place.images is not None:
        _add_cameras(server, place.images, 0.012 * float(np.linalg.norm(size)))
    unit = "m" if place.metric else "units"
    length = " x ".join(f"{extent:.3g}" for extent in size)
    lines = [f"**{place.name}**", f"{length} {unit}, {len(place.gaussians):,} Gaussians"]
    server.gui.add_markdown("\n\n".join([*lines, *place.notes]))
    if place.field is not None:
        _add_distances(server, place, unit)
    return server


def _add_gaussians(server: "viser.ViserServer", place: ShownPlace) -> None:
    scene, p_WQ = place.gaussians, place.gaussians.means
    known = np.arange(len(p_WQ)) < len(p_WQ) - place.num_unknown
    inside = np.all((p_WQ >= place.lower_W) & (p_WQ <= place.upper_W), axis=1)
    low = p_WQ[:, 2] <= place.height
    covariances = replace(scene, scales=np.minimum(scene.scales, _LARGEST)).covariances
    for name, kept, visible in (
        ("gaussians", known & inside & low, True),
        ("above", known & inside & ~low, False),
        ("beyond", known & ~inside, place.beyond),
        ("unknown", ~known, False),
    ):
        if kept.any():
            server.scene.add_gaussian_splats(
                f"/{name}",
                p_WQ[kept],
                covariances[kept],
                scene.base_colors[kept],
                scene.opacities[kept, None],
                visible=visible,
            )


def _add_cameras(server: "viser.ViserServer", images: CapturedImages, size: float) -> None:
    fov_y = 2 * np.arctan(0.5 * images.height / images.K[1, 1])
    for X_WC, name, image in zip(images.X_WCs, images.names, images.images, strict=True):
        camera = server.scene.add_camera_frustum(
            f"/cameras/{name}",
            fov_y,
            images.width / images.height,
            scale=size,
            color=(255, 144, 32),
            image=image[..., ::-1],
            wxyz=X_WC.rotation().ToQuaternion().wxyz(),
            position=X_WC.translation(),
        )

        @camera.on_click
        def _(event: "viser.SceneNodePointerEvent") -> None:
            event.client.camera.wxyz = event.target.wxyz
            event.client.camera.position = event.target.position


def _add_distances(server: "viser.ViserServer", place: ShownPlace, unit: str) -> None:
    field = place.field
    assert field is not None
    margin = 1e-3 * (field.upper_W[2] - field.lower_W[2])  # inside, where the field has an answer
    lower, upper = float(field.lower_W[2] + margin), float(field.upper_W[2] - margin)
    start = min(max(float(place.height), lower), upper)
    drawing = threading.Lock()  # Each change is told in a thread of its own; the last one counts.
    shown = server.gui.add_checkbox("distances", False)
    height = server.gui.add_slider(
        f"at height [{unit}]", lower, upper, (upper - lower) / 200, start,
        hint=f"red at a surface, blue from {place.reach:.3g} {unit}, grey where nobody looked",
    )  # fmt: skip

    def draw(_event: object) -> None:
        with drawing:
            p_WQ, faces, colors = distance_slice(
                field, height.value, 2 * field.voxel_size, place.reach
            )
            rgb = np.round(255 * colors).astype(np.uint8)
            mesh = trimesh.Trimesh(p_WQ, faces, vertex_colors=rgb, process=False)
            server.scene.add_mesh_trimesh("/distances", mesh, visible=shown.value)

    shown.on_update(draw)
    height.on_update(draw)
