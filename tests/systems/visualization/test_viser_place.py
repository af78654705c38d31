"""A place served by viser, in a real browser where there is one."""

import time
import urllib.request

import cv2
import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.analysis.commands.main import main
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.common import extras
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.visualization.pages import CapturedImages, ShownPlace
from splatpilot.systems.visualization.viser_place import serve_place

WIDTH, HEIGHT = 160, 120
K = np.array([[80.0, 0, 80], [0, 80.0, 60], [0, 0, 1]])
UPPER = np.array([6.0, 4.0, 3.0])  # [m], of the place, whose lower corner is in the origin
R_WC = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))  # looking along x, level
X_WC = RigidTransform(R_WC, [0.5, 2.0, 1.2])
BEHIND = RigidTransform(R_WC, [0.1, 2.0, 1.2])  # where an image was captured


def place() -> ShownPlace:
    """Two walls of coloured Gaussians, of which the right one is nearer, before a grey sky."""
    y, z = (v.ravel() for v in np.meshgrid(np.arange(0.1, 4, 0.1), np.arange(0.1, 3, 0.1)))
    means = np.column_stack([np.where(y > 2, 5.0, 3.0), y, z])
    colors = 0.5 + 0.4 * np.column_stack([np.sin(3 * y), np.cos(2 * z), np.sin(2 * y + z)])
    scales = np.tile([0.01, 0.08, 0.08], (len(means), 1))
    turns, shares = np.tile([1.0, 0, 0, 0], (len(means), 1)), np.full(len(means), 0.95)
    occupied = np.zeros((60, 40, 30), bool)
    occupied[30:32, :20] = occupied[50:52, 20:] = True
    image = np.full((12, 16, 3), 90, np.uint8)
    return ShownPlace(
        name="two walls",
        gaussians=GaussianScene.from_colors(means, turns, scales, shares, colors),
        background=(0.3, 0.3, 0.3),
        lower_W=np.zeros(3),
        upper_W=UPPER,
        height=3.0,
        field=esdf_from_occupancy(occupied, np.zeros_like(occupied), np.zeros(3), 0.1),
        ends=(np.array([0.2, 0.2, 1.0]), np.array([0.2, 3.8, 1.0])),
        images=CapturedImages([BEHIND], ["a.jpg"], [image], K, WIDTH, HEIGHT),
    )


@pytest.fixture
def server():
    """Serves the place to this machine alone."""
    pytest.importorskip("viser", reason="viser is not installed")
    server = serve_place(place(), host="127.0.0.1", port=18080)
    yield server
    server.stop()


def test_a_page_is_served(server):
    with urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}") as answer:
        assert answer.status == 200 and b"<html" in answer.read()


def test_a_browser_shows_what_the_camera_sees(server, browser):
    tab = browser.new_page(viewport={"width": 2 * WIDTH, "height": 2 * HEIGHT})
    tab.set_default_timeout(120_000)
    tab.goto(f"http://127.0.0.1:{server.get_port()}")
    tab.get_by_text("two walls").first.wait_for()
    (client,) = server.get_clients().values()

    def picture() -> np.ndarray:
        return client.get_render(
            HEIGHT,
            WIDTH,
            wxyz=R_WC.ToQuaternion().wxyz(),
            position=X_WC.translation(),
            fov=2 * np.arctan(0.5 * HEIGHT / K[1, 1]),
        )[..., :3]

    def until(changed) -> np.ndarray:
        deadline = time.monotonic() + 120
        while not changed(shown := picture()):
            assert time.monotonic() < deadline
        return shown

    truth = BakedScene(place().gaussians).render(K, WIDTH, HEIGHT, X_WC)
    # Pictures that are asked for lack the background, and viser blurs edges otherwise than we do.
    walls = cv2.erode((truth.alpha > 0.99).astype(np.uint8), np.ones((9, 9))) > 0
    expected = np.round(255 * np.clip(truth.color, 0, 1)).astype(np.uint8)[walls]
    floor = np.s_[100:, :60]
    before = until(lambda shown: cv2.PSNR(shown[walls], expected) > 16)[floor]
    tab.get_by_text("distances").click()
    tab.get_by_role("slider").press("Home")
    low = until(lambda shown: np.abs(shown[floor] - 1.0 * before).mean() > 20)[floor]
    tab.get_by_role("slider").press("End")
    until(lambda shown: np.abs(shown[floor] - 1.0 * low).mean() > 20)
    tab.close()


def test_without_viser_the_remedy_is_named(monkeypatch, capsys):

    def absent(name: str):
        raise ModuleNotFoundError(name=name)

    monkeypatch.setattr(extras, "import_module", absent)
    assert main(["view", "P02", "--viser"]) == 1
    assert capsys.readouterr().err.count("splatpilot[viser]") == 1
