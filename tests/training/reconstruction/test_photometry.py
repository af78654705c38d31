import numpy as np
import pytest

from splatpilot.training.captures.tartanair import read_tartanair_v1
from splatpilot.training.reconstruction.photometry import (
    Photometry,
    ThinnedFrame,
    estimate_photometry,
)


def test_recovers_gains_and_vignetting(tmp_path, write_room):
    """Gains and vignetting put into images of one room are found again within a percent or two."""
    truth = Photometry(np.exp(0.1 * np.sin(np.arange(12))), -0.25)
    truth = Photometry(truth.gains / np.exp(np.log(truth.gains).mean()), truth.vignetting)
    room = write_room(
        tmp_path / "room",
        width=160,
        height=120,
        brightness=lambda i, rho: truth.gains[i] * np.exp(truth.vignetting * rho),
    )
    views = [ThinnedFrame.of(frame) for frame in read_tartanair_v1(room).frames()]
    found = estimate_photometry(views, seed=0)
    np.testing.assert_allclose(found.gains, truth.gains, rtol=0.02)
    assert found.vignetting == pytest.approx(truth.vignetting, abs=0.03)
    again = estimate_photometry(views, seed=0)
    np.testing.assert_array_equal(found.gains, again.gains)


def test_views_that_share_nothing_have_gain_one(tmp_path, write_room):
    """Without common points nothing is corrected."""
    views = [
        ThinnedFrame.of(frame)
        for frame in read_tartanair_v1(write_room(tmp_path / "room")).frames()
    ][:1]
    found = estimate_photometry(views, seed=0)
    assert (found.gains.tolist(), found.vignetting) == ([1.0], 0.0)


def test_factor_is_gain_in_the_centre_and_darker_in_the_corners():
    """The factor is the gain in the image centre, and gain times exp(vignetting) in the corners."""
    factor = Photometry(np.array([1.0, 2.0]), -0.5).factor(1, 481, 641)
    assert factor.shape == (481, 641)
    assert factor[240, 320] == pytest.approx(2)
    assert factor[0, 0] == pytest.approx(2 * np.exp(-0.5), rel=5e-3)
