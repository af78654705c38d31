"""Everything that reads what others wrote, on damaged files; `make fuzz` tries many more."""

import time

import numpy as np
import pytest

from fuzz import campaign
from fuzz.campaign import ALL, cases, outcome_of
from fuzz.mutations import damage
from fuzz.readers import Reader

SHORT = 15


def test_damage_is_drawn_from_the_seed():
    """The same seed makes the same damage, another one another; nearly all of it is damage."""
    content = b"seed: 3\ntimeout: [1, 2]\nname: {a: 1.5}\n" * 20
    made = [damage(content, np.random.default_rng([7, k])) for k in range(50)]
    assert made == [damage(content, np.random.default_rng([7, k])) for k in range(50)]
    assert len(set(made)) > 35
    assert sum(one == content for one in made) < 5


@pytest.mark.parametrize("name", ALL)
def test_reader_withstands_damage(name):
    """Damaged files are refused in one sentence that names them, or accepted and then of use."""
    wrong = [each for each in cases(name, 0, SHORT, 1) if each.kind not in ("accepted", "refused")]
    assert not wrong


def _raise(error):
    raise error


@pytest.mark.parametrize(
    ("read", "use", "kind"),
    [
        (lambda folder: _raise(ValueError(f"{folder}/a is wrong")), print, "refused"),
        (lambda folder: _raise(OSError(f"{folder}/a is wrong")), print, "refused"),
        (lambda folder: _raise(ValueError("something is wrong")), print, "weak"),
        (lambda folder: _raise(ValueError(f"{folder}/a\nis wrong")), print, "weak"),
        (lambda folder: _raise(ValueError(f"{folder}/a {'x' * 999}")), print, "weak"),
        (lambda folder: _raise(KeyError("a")), print, "traceback"),
        (lambda folder: _raise(MemoryError()), print, "traceback"),
        (lambda folder: time.sleep(9), print, "hang"),
        (lambda folder: 3, lambda read: time.sleep(9), "hang"),
        (lambda folder: 3, lambda read: _raise(AssertionError("not 4")), "nonsense"),
        (lambda folder: 3, lambda read: None, "accepted"),
    ],
)
def test_what_is_wrong_is_found(tmp_path, monkeypatch, read, use, kind):
    """Readers that raise what they may not, that name no file, that accept nonsense or wait for
    ever are found as such, and good ones are not."""
    monkeypatch.setattr(campaign, "TIME_LIMIT", 0.1)
    reader = Reader(lambda folder: None, "*", read, use)
    assert outcome_of(reader, tmp_path, tmp_path / "a")[0] == kind
