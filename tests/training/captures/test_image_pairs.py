import cv2
import numpy as np
import pytest

from splatpilot.training.captures.colmap import (
    import_pycolmap,
    likely_pairs,
    similarity,
    vlad_similarity,
)


@pytest.mark.parametrize("partners", [4, 8])
def test_likely_pairs(partners):
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 0.1, (40, 40))
    similarity = noise + noise.T
    for a in range(20):  # The second half goes the way of the first again.
        similarity[a, a + 20] = similarity[a + 20, a] = 1.0
    pairs = likely_pairs(similarity, partners)
    assert pairs == sorted(set(pairs)) and all(a < b for a, b in pairs)
    assert {(a, a + 1) for a in range(39)} <= set(pairs)
    assert {(a, a + 20) for a in range(20)} <= set(pairs)
    assert 40 * partners / 2 - partners**2 <= len(pairs) <= 40 * partners


def test_images_of_one_place_look_alike():
    rng = np.random.default_rng(1)
    places = [rng.normal(size=(400, 16)).astype(np.float32) for _ in range(3)]
    features = [
        place[rng.choice(400, 250, replace=False)] + rng.normal(0, 0.05, (250, 16))
        for place in places
        for _ in range(2)
    ]
    features = [each.astype(np.float32) for each in features] + [np.zeros((0, 16), np.float32)]
    similarity = vlad_similarity(features)
    np.testing.assert_allclose(similarity, similarity.T, atol=1e-12)
    np.testing.assert_allclose(np.diag(similarity)[:6], 1.0)
    for i in range(6):
        others = np.delete(similarity[i], [i, i ^ 1])
        assert similarity[i, i ^ 1] > others.max() + 0.2
    assert np.abs(similarity[6]).max() < 1e-6


def test_features_of_a_database(tmp_path):
    pycolmap = import_pycolmap()
    rng = np.random.default_rng(2)
    places = [
        cv2.resize(rng.integers(0, 255, (60, 80), dtype=np.uint8), (320, 240)) for _ in range(2)
    ]
    names = [f"{i}.png" for i in range(4)]
    for name, image in zip(
        names, [p[:, s : s + 280] for p in places for s in (0, 40)], strict=True
    ):
        cv2.imwrite(str(tmp_path / name), image)
    file = tmp_path / "features.db"
    pycolmap.Database.open(file).close()
    pycolmap.import_images(file, tmp_path, pycolmap.CameraMode.SINGLE, names)
    pycolmap.extract_features(
        file, tmp_path, names, extraction_options=pycolmap.FeatureExtractionOptions(use_gpu=False)
    )
    database = pycolmap.Database.open(file)
    found = similarity(database, names)
    database.close()
    assert min(found[0, 1], found[2, 3]) > found[:2, 2:].max() + 0.2
