import pytest

from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.parameters import learning_rates


def test_rates_are_those_published_where_gaussians_start_anywhere():
    """Only the means' falls, to a hundredth, and is scaled by the extent."""
    config = ReconstructConfig(initialization="points")
    first, last = (learning_rates(config, 3.0, part) for part in (0.0, 1.0))
    assert first["means"] == pytest.approx(3.0 * 1.6e-4)
    assert last["means"] == pytest.approx(first["means"] / 100)
    assert {n: r for n, r in first.items() if n != "means"} == {
        "quats": 1e-3, "log_scales": 5e-3, "logit_opacities": 5e-2, "sh_0": 2.5e-3,
        "sh_rest": 1.25e-4,
    }  # fmt: skip
    assert all(last[name] == first[name] for name in first if name != "means")


def test_on_surfaces_shapes_and_colours_are_fast_at_first_and_slow_at_last():
    """The means move slower than those that start anywhere, the others faster, and all but the
    means fall to a tenth along half a cosine."""
    anywhere = learning_rates(ReconstructConfig(initialization="points"), 1.0, 0.0)
    config = ReconstructConfig(initialization="depth")
    first, middle, last = (learning_rates(config, 1.0, part) for part in (0.0, 0.5, 1.0))
    assert first["means"] == pytest.approx(anywhere["means"] / 4)
    for name in first.keys() - {"means"}:
        assert first[name] >= anywhere[name]
        assert middle[name] == pytest.approx(0.55 * first[name])
        assert last[name] == pytest.approx(0.1 * first[name])
