"""What frozen modules make of images, kept in files."""

from pathlib import Path

import numpy as np
import pytest
import torch

from splatpilot.systems.policies.student import StudentSpec
from splatpilot.systems.sensing.noise import ObservationNoise
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.policies.student_data import StudentData
from splatpilot.training.policies.student_features import FrozenFeatures
from splatpilot.training.policies.student_images import Appearance, clean_images
from splatpilot.training.policies.student_network import StudentModule

FROZEN = 15


@pytest.fixture(scope="module")
def data(student_corpus) -> StudentData:
    return StudentData([Corpus(student_corpus)], 0.2)


@pytest.fixture(scope="module")
def network() -> StudentModule:
    torch.manual_seed(0)
    return StudentModule(StudentSpec("depth", 32, 24))


def features(folder: Path, data, network, noise=0.3, draws=2, mirrored=False) -> FrozenFeatures:
    disturbed = ObservationNoise(depth_additive=noise)
    return FrozenFeatures(folder, data, network, FROZEN, draws, Appearance(), disturbed, mirrored)


def test_features_are_those_of_the_modules(data, network, tmp_path):
    """Held-out images are encoded as they are, the others as often as is asked, each time through
    other noise; without any noise as they are, to half precision."""
    kept = features(tmp_path, data, network)
    numbers = data.held_out[[3, 0, 7]]
    with torch.no_grad():
        expected = network.features[:FROZEN](clean_images(data.pixels(numbers, "depth")))
    found = kept(numbers, np.zeros(3, int))
    torch.testing.assert_close(found, expected, atol=4e-3, rtol=4e-3)
    numbers = data.training[[5, 30]]
    first, second = (kept(numbers, np.full(2, draw)) for draw in (0, 1))
    assert not torch.allclose(first[0], second[0]) and not torch.allclose(first[1], second[1])
    bare = features(tmp_path, data, network, noise=0.0)
    with torch.no_grad():
        expected = network.features[:FROZEN](clean_images(data.pixels(numbers, "depth")))
    torch.testing.assert_close(bare(numbers, np.ones(2, int)), expected, atol=4e-3, rtol=4e-3)


def test_features_in_a_mirror(data, network, tmp_path):
    """They are what the modules make of mirrored images, beside the others in the same folder."""
    plain = features(tmp_path, data, network, noise=0.0, draws=1)
    mirrored = features(tmp_path, data, network, noise=0.0, draws=1, mirrored=True)
    numbers, draws = data.training[[5, 30]], np.zeros(2, int)
    pixels = data.pixels(numbers, "depth")
    for kept, images in ((plain, pixels), (mirrored, np.ascontiguousarray(pixels[..., ::-1]))):
        with torch.no_grad():
            expected = network.features[:FROZEN](clean_images(images))
        torch.testing.assert_close(kept(numbers, draws), expected, atol=4e-3, rtol=4e-3)


def test_files_are_made_once_for_all_that_they_depend_on(data, network, tmp_path):
    """The same again makes nothing; what was lost is made again with the same bytes; other noise,
    other draws or other weights make files of their own."""
    features(tmp_path, data, network)
    made = {file: (file.stat().st_mtime_ns, file.read_bytes()) for file in tmp_path.iterdir()}
    assert len(made) == 2 * len(data.shards)  # What the first seven modules make is kept too.
    lost = min(made)
    lost.unlink()
    features(tmp_path, data, network)
    for file, (time, content) in made.items():
        assert file.read_bytes() == content and (file == lost) != (file.stat().st_mtime_ns == time)
    with torch.no_grad():
        network.features[0][0].weight[0, 0, 0, 0] += 1.0
    features(tmp_path, data, network)
    features(tmp_path, data, network, noise=0.1)
    features(tmp_path, data, network, draws=1)
    assert len(list(tmp_path.iterdir())) == 4 * len(made)


@pytest.mark.parametrize("content", [b"", b"junk", None])
def test_damaged_files_are_made_anew(data, network, tmp_path, content):
    """Of a file that is empty, none or cut short the features are computed again, and are the
    same."""
    expected = features(tmp_path, data, network)(data.training[[5]], np.zeros(1, int))
    for file in tmp_path.iterdir():
        file.write_bytes(file.read_bytes()[:-100] if content is None else content)
    found = features(tmp_path, data, network)(data.training[[5]], np.zeros(1, int))
    torch.testing.assert_close(found, expected, atol=0, rtol=0)
