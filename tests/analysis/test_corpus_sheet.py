import cv2
import numpy as np
import pytest

from splatpilot.analysis.commands.main import main
from splatpilot.analysis.figures import project
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.training.corpus.corpus import Corpus


def test_points_in_front_of_the_camera_are_projected():
    camera = OnboardCamera(width=160, height=120, fov_x=90.0)
    points = [[2.1, 0, 0], [2.1, 1.0, 0], [4.1, 0, 1.0], [-1.0, 0, 0], [0.1, 0, 0]]
    expected = [[80, 60], [40, 60], [80, 40]]
    np.testing.assert_allclose(project(camera, np.array(points)), expected, atol=1e-9)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, set_fields):
    """A corpus of one small room."""
    out = tmp_path_factory.mktemp("corpus")
    fields = set_fields(
        "worlds.kinds=[P10]", "flights=1", "expert.period=0.6",
        "camera.width=48", "camera.height=36", "appearance=0",
    )  # fmt: skip
    assert main(["corpus", "make", "--out", str(out), "--worlds=1", "--jobs=1", *fields]) == 0
    return out


def test_inspect_draws_a_tile_for_each_sample(folder, tmp_path, capsys):
    sheet = tmp_path / "sheets" / "sheet.png"
    words = ["corpus", "inspect", str(folder), "--out", str(sheet), "--samples", "3"]
    assert main(words) == 0
    corpus = Corpus(folder)
    assert f"{len(corpus)} samples" in capsys.readouterr().out
    image = cv2.imread(str(sheet))[..., ::-1]
    assert image.shape == (2 * 3 * 36, 3 * 3 * 48, 3)
    chosen = np.sort(np.random.default_rng(0).choice(len(corpus), 3, replace=False))
    colors = corpus.samples(chosen).color
    for k, color in enumerate(colors):
        tile = image[: 3 * 36, k * 3 * 48 : (k + 1) * 3 * 48]
        same = (tile[1::3, 1::3] == color).all(axis=2)
        assert same.mean() > 0.5
        assert not same.all()
