"""Pages of flights, in a real browser where there is one."""

import base64
import dataclasses
import gzip
import re

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from splatpilot.systems.collision.shapes import MovingSpheres
from splatpilot.systems.policies.hypotheses import Hypotheses
from splatpilot.systems.splats.background import EnvironmentMap
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.visualization.meshcat_drawing import draw_vehicle
from splatpilot.systems.visualization.pages import (
    Frames,
    ReplayedFlight,
    ReplayView,
    jpeg,
    pack_gaussians,
    replay_page,
)

WIDTH, HEIGHT, FOV_Y = 240, 180, 1.2
# Optical axes (x right, y down, z forward) in a body with x forward, y left, z up.
X_BC = RigidTransform(RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])), [0.1, 0, 0])
VIEW = ReplayView("forest, seed 3", X_BC, FOV_Y, radius=0.35, lower=0.0, upper=4.0)

SETTLED = (
    "window.replay && replay.splats.settled"
    " && viewer.scene_tree.find(['splatpilot', 'vehicles', '0', 'body']).object.children.length > 0"
)


def cloud(generator: np.random.Generator, count: int = 400) -> GaussianScene:
    """Blobs of all shapes and shades within a box ahead of the origin."""
    return GaussianScene.from_colors(
        means=generator.uniform([2, -3, 0], [9, 3, 3], (count, 3)),
        quats=generator.normal(size=(count, 4)),
        scales=generator.uniform(0.02, 0.35, (count, 3)),
        opacities=generator.uniform(0.2, 1.0, count),
        colors=generator.uniform(size=(count, 3)),
    )


def straight(name: str, outcome: str, y: float = 0.0, roll: float = 0.0) -> ReplayedFlight:
    """4 s along x at 0.25 m/s; clearance falls from 1 m to 0; plans and frames every 0.5 s."""
    times = np.linspace(0, 4, 81)
    states = np.array([hover_state([0.25 * t, y, 1.5]) for t in times])
    q = RollPitchYaw(roll, 0, 0).ToQuaternion().wxyz()
    states[:, 6:10], states[:, 3] = q, 0.25
    ahead = np.linspace(0.2, 2, 10)[:, None] * np.array([1.0, 0, 0])
    waypoints = ahead + np.array([0, 0.5, -0.5])[:, None, None] * np.array([0.0, 1, 0])
    plans = [
        Hypotheses(t, RigidTransform([0.25 * t, y, 1.5]), waypoints, np.array([1.0, 2, 3]))
        for t in np.arange(0, 4, 0.5)
    ]
    vectors = np.array([plan.to_vector() for plan in plans])
    shades = [np.full((48, 64, 3), 30 * k, np.uint8) for k in range(8)]
    frames = Frames(0.5, list(map(jpeg, shades)), [jpeg(255 - shade) for shade in shades])
    return ReplayedFlight(name, outcome, times, states, 1 - times / 4, vectors, frames)


@pytest.fixture
def open_page(open_in_browser, plain_meshcat):
    """Opens a page of flights; its window is as large as the onboard camera's image."""

    def opened(gaussians, flights, background=(0.2, 0.4, 0.6), spheres=None, view=VIEW):
        meshcat = plain_meshcat(background if isinstance(background, tuple) else (0.0, 0.0, 0.0))
        meshcat.SetCameraPose([-2, 0, 4], [4, 0, 1.5])
        for k in range(len(flights)):
            draw_vehicle(meshcat, f"/splatpilot/vehicles/{k}", 0.35)
        html = replay_page(meshcat.StaticHtml(), gaussians, background, view, flights, spheres)
        return open_in_browser(html, WIDTH, HEIGHT, SETTLED, "#replay-panel, #replay-bar")

    return opened


def seen(gaussians, background, X_WB: RigidTransform) -> np.ndarray:
    """The onboard camera's image, in the format of `Page.picture`."""
    K = CameraInfo(WIDTH, HEIGHT, FOV_Y).intrinsic_matrix()
    view = BakedScene(gaussians).render(K, WIDTH, HEIGHT, X_WB @ X_BC, 0.01, 1e3, background)
    return np.round(255 * np.clip(view.color[..., ::-1], 0, 1)).astype(np.uint8)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return 10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2))


SKY = EnvironmentMap(
    cv2.resize(np.random.default_rng(5).uniform(size=(4, 8, 3)).astype(np.float32), (64, 32))
)


@pytest.mark.parametrize("background", [(0.2, 0.4, 0.6), SKY])
def test_page_shows_what_the_camera_sees(open_page, background):
    gaussians = cloud(np.random.default_rng(0))
    page = open_page(gaussians, [straight("a", "goal", roll=0.4)], background)
    page.run(
        "() => { replay.look('onboard'); replay.seek(2);"
        " replay.flights[0].fan.scale.set(0, 0, 0); }"
    )
    X_WB = RigidTransform(RollPitchYaw(0.4, 0, 0), [0.5, 0, 1.5])
    truth = seen(gaussians, background, X_WB)
    assert psnr(page.picture(), truth) > 30
    page.run("() => { replay.splats.mesh.visible = false; viewer.set_dirty(); }")
    assert psnr(page.picture(), truth) < 20


def test_controls_move_time_and_view_and_playback_changes_speed_and_loops(open_page):
    flight = straight("a", "goal")
    flight.hypotheses[-1, -1], flight.clearances[3] = np.inf, np.inf
    page = open_page(cloud(np.random.default_rng(1)), [flight])
    assert page.run("() => viewer.camera.far") == 1000
    page.tab.select_option("#replay-speed", "4")
    page.run("() => { replay.seek(0); replay.play(true); }")
    page.tab.wait_for_function("!replay.playing")
    assert page.run("() => replay.time") == 4.0
    page.tab.keyboard.press("l")
    # Beyond the end it starts again, and does not stop.
    looped = "() => { replay.play(true); replay.seek(4.5); return [replay.time, replay.playing]; }"
    assert page.tab.evaluate(looped) == [0, True]
    page.run("() => replay.play(false)")
    # The mouse does not lead below the ground.
    assert page.run("() => viewer.controls.maxPolarAngle") == pytest.approx(np.pi / 2)

    page.run("() => replay.look('chase')")
    for time in (0.0, 1.0, 3.9):
        x, y, depth = page.run(
            f"""() => {{
              replay.seek({time});
              viewer.render();
              const p = replay.flights[0].sphere.getWorldPosition(new MeshCat.THREE.Vector3());
              return p.project(viewer.camera).toArray();
            }}"""
        )
        assert abs(x) < 0.5 and abs(y) < 0.5 and -1 < depth < 1
        red, green, _ = page.run("() => replay.flights[0].sphere.material.color.toArray()")
        assert (red > green) == (1 - time / 4 < VIEW.margin)
        shade = page.run(
            "() => document.getElementById('replay-picture').getContext('2d')"
            ".getImageData(9, 9, 1, 1).data[0]"
        )
        assert shade == pytest.approx(30 * int(time / 0.5), abs=3)
    page.set_slider("replay-time", 1)
    assert page.run("() => replay.time") == 1.0
    page.tab.keyboard.press("ArrowRight")
    assert page.run("() => replay.time") == pytest.approx(1.1)
    before = page.picture()
    page.tab.keyboard.press("1")
    assert page.run("() => replay.view") == "overview"
    assert psnr(page.picture(), before) < 25
    # Half of the Gaussians are above 1.5 m; the cut hides them.
    whole = page.run("() => { replay.setCut(9); }") or page.picture()
    page.run("() => { replay.setCut(1.5); }")
    assert psnr(page.picture(), whole) < 25


def test_flights_are_told_apart_and_crashes_start_before_their_end(open_page):
    spheres = MovingSpheres([0.5], [np.array([[3.0, 0, 1], [4.0, 0, 1], [np.inf] * 3])], period=2.0)
    flights = [straight("a", "collision"), straight("b", "goal", y=1.0)]
    flights[1].states[:, 3] = 0.75
    page = open_page(cloud(np.random.default_rng(2)), flights, spheres=spheres)
    assert page.run("() => replay.time") == pytest.approx(2.0)
    positions = page.run("() => replay.flights.map((f) => f.vehicle.matrix.elements.slice(12, 15))")
    np.testing.assert_allclose(positions, [[0.5, 0, 1.5], [0.5, 1, 1.5]], atol=1e-3)
    page.run("() => replay.choose(replay.flights[1])")
    assert page.run("() => replay.flights.map((f) => Boolean(f.fan.visible))") == [False, True]
    for time, x in ((1, 3.0), (2.5, 4.0), (4, None)):
        page.run(f"() => replay.seek({time})")
        sphere = page.run("() => Array.from(replay.spheres.mesh.instanceMatrix.array)")
        if x is None:
            assert sphere[0] == 0
        else:
            placed = np.array([[0.5, 0, 0, x], [0, 0.5, 0, 0], [0, 0, 0.5, 1]])
            np.testing.assert_allclose(np.reshape(sphere, (4, 4)).T[:3], placed, atol=1e-6)

    # Curves lie over one another on axes, in the colors of the trails.
    assert page.run("() => Plot.ticks(-0.3, 4, 4)") == [0, 2, 4]
    assert page.run("() => Plot.ticks(0, 1, 4)") == [0, 0.5, 1]
    colors = page.run("() => replay.flights.map((f) => f.color)")
    trails = page.run("() => replay.flights.map((f) => f.trail.material.color.getHex())")
    assert len(set(colors)) == len(set(trails)) == 2
    for color, speed in zip(colors, (0.25, 0.75), strict=True):
        pixel = page.run(
            f"""() => {{
              replay.seek(0);
              const plot = replay.plots[0], context = plot.canvas.getContext("2d");
              const [x, y] = [plot.x(3), plot.y({speed})].map(Math.round);
              return Array.from(context.getImageData(x, y, 1, 1).data.slice(0, 3));
            }}"""
        )
        assert "#" + bytes(pixel).hex() == color


def test_page_names_its_environment_hides_the_frontier_from_above_and_fits_phones(open_page):
    view = dataclasses.replace(VIEW, num_frontier=100)
    page = open_page(cloud(np.random.default_rng(1)), [straight("a", "goal")], view=view)
    shown = "() => replay.splats.mesh.material.uniforms.shown.value"
    assert page.run(shown) == 300
    page.tab.keyboard.press("u")
    assert page.run(shown) == 400
    page.run("() => replay.look('onboard')")
    assert page.run(shown) == 400
    page.tab.keyboard.press("1")
    assert page.run(shown) == 300

    assert page.tab.title() == "forest, seed 3"
    content = page.tab.get_attribute("meta[name=viewport]", "content")
    assert content == "width=device-width, initial-scale=1"
    # The window is narrow: the panel is closed at first.
    page.tab.set_viewport_size({"width": 390, "height": 844})
    assert "forest, seed 3" in page.tab.inner_text("#replay-panel")
    assert not page.tab.is_visible("#replay-picture")
    page.tab.click("#replay-panel header button")
    assert page.tab.is_visible("#replay-picture") and not page.tab.is_visible("#replay-scale")
    page.tab.keyboard.press("d")
    assert "0.5 m" in page.tab.inner_text("#replay-scale")


def test_page_holds_its_gaussians_is_the_same_every_time_and_needs_a_flight():
    gaussians, flights = cloud(np.random.default_rng(4)), [straight("a", "goal")]
    pages = [replay_page("<body></body>", gaussians, SKY, VIEW, flights) for _ in range(2)]
    assert pages[0] == pages[1]
    packed = re.search(r'id="gaussians">([^<]*)<', pages[0])
    assert packed is not None
    held = np.frombuffer(gzip.decompress(base64.b64decode(packed[1])), np.uint32)
    np.testing.assert_array_equal(held.reshape(-1, 8), pack_gaussians(gaussians))
    with pytest.raises(ValueError, match="flights must be at least one"):
        replay_page("<body></body>", gaussians, SKY, VIEW, [])
