"""What the network takes of samples: as they are or disturbed, and perhaps in a mirror."""

import numpy as np
import pytest
import torch

from splatpilot.systems.common.config import load_config
from splatpilot.systems.policies.student import StudentSpec
from splatpilot.training.corpus.corpus import Corpus
from splatpilot.training.policies.student_config import StudentRgbTraining
from splatpilot.training.policies.student_data import StudentData
from splatpilot.training.policies.student_images import clean_images
from splatpilot.training.policies.student_network import StudentModule
from splatpilot.training.policies.train_student import StudentViews
from splatpilot.training.policies.trainer_registry import TRAINERS

NUMBERS = 4


@pytest.fixture(scope="module")
def data(student_corpus) -> StudentData:
    return StudentData([Corpus(student_corpus)], 0.2)


def training(corpus, *overrides: str) -> StudentRgbTraining:
    always = f"corpora=[{corpus}]", "held_out=0.2", "pretrained=false", "noise.brightness_jitter=1"
    return load_config(TRAINERS.find("student_rgb").config(), overrides=[*always, *overrides])


@pytest.mark.parametrize("frozen", [0, 3])
def test_rows_are_what_they_are_said_to_be(data, student_corpus, tmp_path, frozen):
    """As they are or darker or brighter, and in a mirror or not, each row by itself; of what frozen
    modules made as of images."""
    features = f"features={tmp_path}"
    config = training(student_corpus, f"frozen={frozen}", features, "mirrored=true", "disturbed=.5")
    torch.manual_seed(0)
    network = StudentModule(StudentSpec("rgb", 32, 24))
    views, numbers = StudentViews(config, data, network), data.training[:NUMBERS]
    disturbed, mirrored = np.array([False, False, True, True]), np.array([False, True] * 2)
    if frozen:
        seen = views.kept(numbers, np.zeros(NUMBERS, int), disturbed, mirrored)
    else:
        seen = views.anew(numbers, disturbed, mirrored, torch.Generator().manual_seed(0))
    pixels = data.pixels(numbers, "color")
    pixels[mirrored] = pixels[mirrored, :, ::-1]
    with torch.no_grad():
        as_they_are = network.encode_image(clean_images(pixels), 0, frozen)
    same = [
        torch.allclose(a, b, atol=4e-3, rtol=4e-3) for a, b in zip(seen, as_they_are, strict=True)
    ]
    assert same == [True, True, False, False]


@pytest.mark.parametrize(("part", "least", "most"), [(0.0, 0, 0), (0.3, 10, 30), (1.0, 64, 64)])
def test_the_part_that_is_asked_for_is_disturbed(student_corpus, part, least, most):
    """At random; none and all are exactly so."""
    overrides = ["frozen=0", "batch=64", f"disturbed={part}"]
    trainer = TRAINERS.find("student_rgb").make(training(student_corpus, *overrides))
    numbers, asked = np.resize(trainer._data.training, 64), []
    trainer._views.anew = lambda numbers, disturbed, *others: asked.append(disturbed)
    trainer._drawn_images(numbers, np.zeros(64, bool))
    assert least <= asked[0].sum() <= most
