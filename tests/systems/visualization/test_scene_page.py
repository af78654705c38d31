"""Pages of scenes, in a real browser if there is one."""

import cv2
import numpy as np
import pytest
from baked_scenes import uniform_scene
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.visualization.meshcat_drawing import draw_box
from splatpilot.systems.visualization.pages import CapturedImages, ViewerScene, scene_page

WIDTH, HEIGHT = 480, 360
UPPER = np.array([6.0, 4.0, 2.5])  # [m], of the room, whose lower corner is in the origin
K = np.array([[60.0, 0, 60], [0, 60.0, 45], [0, 0, 1]])
R_WC = RotationMatrix(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))  # looking along x, level
X_WCS = [RigidTransform(R_WC, [0.5 + i, 2.0, 1.2]) for i in range(3)]
SHADES = ((40, 40, 200), (40, 200, 40), (200, 40, 40))  # of the images, blue first


def disks(step: float = 0.08) -> GaussianScene:
    """Walls, floor and ceiling of the room, in waves of gray, as flat disks."""
    means, quats = [], []
    turns = [(0.5**0.5, 0, 0.5**0.5, 0), (0.5**0.5, 0.5**0.5, 0, 0), (1, 0, 0, 0)]
    for axis in range(3):
        other = [a for a in range(3) if a != axis]
        grids = np.meshgrid(*(np.arange(step / 2, UPPER[a], step) for a in other), indexing="ij")
        for at in (0.0, UPPER[axis]):
            points = np.full((grids[0].size, 3), at)
            points[:, other] = np.stack(grids, -1).reshape(-1, 2)
            means.append(points)
            quats.append(np.tile(turns[axis], (len(points), 1)))
    means = np.concatenate(means)
    shade = 0.5 + 0.15 * np.sin(4 * means).sum(axis=1)
    size = [0.6 * step, 0.6 * step, 0.002]
    return uniform_scene(means, size, 0.95, shade[:, None] * [1, 1, 1], np.concatenate(quats))


def room(**options) -> ViewerScene:
    """The room, with a block in its middle and an unknown far end."""
    occupied, unknown = np.zeros((2, 60, 40, 25), bool)
    occupied[25:35, 15:25] = True
    unknown[50:] = True
    images = [np.full((90, 120, 3), shade, np.uint8) for shade in SHADES]
    images = CapturedImages(X_WCS, ["a.jpg", "b.jpg", "c.jpg"], images, K, 120, 90)
    fields = {
        "gaussians": disks(),
        "background": (0.0, 0.0, 0.0),
        "lower_W": np.full(3, -0.2),
        "upper_W": UPPER + 0.2,
        "height": 2.0,
        "field": esdf_from_occupancy(occupied, unknown, np.zeros(3), 0.1),
        "images": images,
        "scale_command": "splatpilot scene scale room --out room-scaled",
    } | options
    return ViewerScene(name="room", **fields)


@pytest.fixture
def open_page(open_in_browser, plain_meshcat):
    def opened(scene: ViewerScene, width: int = WIDTH):
        meshcat = plain_meshcat(scene.background)
        draw_box(meshcat, "/splatpilot/bounds", scene.lower_W, scene.upper_W)
        html = scene_page(meshcat.StaticHtml(), scene)
        settled = "window.view && view.splats.settled"
        return open_in_browser(html, width, HEIGHT, settled, "#view-panel, #view-bar")

    return opened


def pixels_of(page, points) -> list[list[float]]:
    """Positions of points of W in the window [px]."""
    return page.run(
        f"""() => {{
          viewer.render();
          return {np.asarray(points).tolist()}.map((p) => {{
            const q = viewer.scene.localToWorld(new MeshCat.THREE.Vector3(...p));
            q.project(viewer.camera);
            return [(0.5 + 0.5 * q.x) * innerWidth, (0.5 - 0.5 * q.y) * innerHeight];
          }});
        }}"""
    )


def differ(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a.astype(float) - b).mean())


def test_ruler_measures_the_room(open_page):
    page = open_page(room(images=None), width=900)
    floor, wall = [1.0, 1.0, 0.0], [4.5, 4.0, 1.1]
    page.tab.click("#view-ruler")
    page.picture()  # Without the panel and the bar.
    for x, y in pixels_of(page, [floor, wall]):
        page.tab.mouse.click(x, y)
    points = np.array(page.run("() => view.ruler.points"))
    # A click is on whole pixels: of 2 cm here.
    np.testing.assert_allclose(points, [floor, wall], atol=0.03)
    true = np.linalg.norm(np.subtract(floor, wall))
    assert page.run("() => view.ruler.length") == pytest.approx(true, abs=0.03)
    assert page.tab.inner_text("#view-label") == f"{np.linalg.norm(points[1] - points[0]):.2f} m"
    said = page.tab.text_content("#view-result")
    assert "splatpilot scene scale room --out room-scaled --between " in said
    page.tab.mouse.click(*pixels_of(page, [[7.5, 3.0, 0.0]])[0])
    assert "No surface is there" in page.tab.text_content("#view-result")
    page.tab.keyboard.press("r")
    assert page.run("() => view.ruler.points") == []


def test_slider_and_switches_change_the_picture(open_page):
    merged = disks()
    for position in ([9.0, 2, 0.5], [3.0, 2, 1]):  # beyond the bounds, and before unknown space
        merged = merged.merged_with(uniform_scene([position], [0.5] * 3, 0.95, (1, 1, 1)))
    page = open_page(room(gaussians=merged, num_frontier=1, beyond=False, images=None))

    def below(x):
        return page.run(f"() => surfaceAlong(view.splats, [{x}, 2, 9], [0, 0, -1], [0, 0, -1])")

    low = page.picture()
    assert below(9.0) is None
    assert below(3.0)[2] == pytest.approx(0.0, abs=0.01)
    page.tab.keyboard.press("b")
    assert below(9.0)[2] == pytest.approx(0.5, abs=0.01)
    page.tab.keyboard.press("u")
    assert below(3.0)[2] == pytest.approx(1.0, abs=0.01)
    assert differ(page.picture(), low) > 2
    for key in ("b", "u"):
        page.tab.keyboard.press(key)
    whole = page.run("() => view.setHeight(2.7)") or page.picture()
    assert differ(low, whole) > 10  # The ceiling.
    page.set_slider("view-height", 1.05)
    plain = page.picture()
    assert page.run("() => view.height") == pytest.approx(1.05)
    page.tab.keyboard.press("f")
    sliced = page.picture()
    assert differ(plain, sliced) > 10

    def pixel(i, j):
        start = 4 * (i + 60 * j)
        data = f"view.slice.texture.image.data.slice({start}, {start + 3})"
        return page.run(f"() => Array.from({data})")

    field = room().field
    assert field is not None
    for i, j in ((30, 20), (20, 20), (5, 3)):
        d = np.clip(field.distances[i, j, 10] / 2.0, 0, 1)
        red, green, blue = pixel(i, j)
        assert green == pytest.approx(255 * (1 - abs(2 * d - 1)), abs=3)
        assert blue == pytest.approx(255 * d**2, abs=3)
        assert red == pytest.approx(255 * min(1.0, 2 - 2 * d), abs=3)
    assert pixel(55, 3) in ([102] * 3, [61] * 3)


def test_frustum_shows_its_image_when_clicked_and_rays_end_on_surfaces(open_page):
    scene = room()
    page = open_page(scene)
    page.run("() => view.setHeight(1.5)")
    p_WQ = X_WCS[1].multiply([0.0, 0.0, 0.6 * page.run("() => view.cameras.size")])
    before = page.picture()
    page.tab.mouse.click(*pixels_of(page, [p_WQ])[0])
    page.tab.wait_for_function("view.cameras.picture.visible")
    assert page.run("() => view.cameras.chosen") == 1
    assert page.tab.text_content("#view-panel").count("b.jpg") == 1
    source = page.tab.get_attribute("#view-image", "src")
    assert source == page.run("() => view.cameras.source(1)")
    picture = page.picture()
    corner = X_WCS[1].multiply([0.0, 0.0, page.run("() => view.cameras.size")])
    x, y = np.round(pixels_of(page, [corner])[0]).astype(int)
    assert picture[y, x].argmax() == 1  # Its green.
    assert differ(before[y : y + 1, x : x + 1], picture[y : y + 1, x : x + 1]) > 20

    page.run("() => view.lookFromCamera()")
    truth = BakedScene(scene.gaussians).render(4 * K * [[1], [1], [0.25]], WIDTH, HEIGHT, X_WCS[1])
    seen = np.round(255 * np.clip(truth.color[..., ::-1], 0, 1)).astype(np.uint8)
    assert differ(cv2.blur(page.picture(), (5, 5)), cv2.blur(seen, (5, 5))) < 3

    # Rays end where the camera measures the surface.
    page.run("() => { view.choose(0); view.lookFromCamera(); }")
    depth = BakedScene(scene.gaussians).render(K, 120, 90, X_WCS[0]).depth
    for u, v in ((60, 45), (20, 20), (100, 80), (75, 70), (31, 8)):
        ray_C = np.array([(u + 0.5 - 60) / 60, (v + 0.5 - 45) / 60, 1.0])
        z = depth[v, u]
        eye = X_WCS[0].translation().tolist()
        ray = (R_WC @ (ray_C / np.linalg.norm(ray_C))).tolist()
        p = page.run(f"() => surfaceAlong(view.splats, {eye}, {ray}, [1, 0, 0])")
        np.testing.assert_allclose(p, X_WCS[0].multiply(z * ray_C), atol=0.01)
