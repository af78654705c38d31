import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.symbolic import Expression
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

from splatpilot.systems.vehicle.wind import DrydenWind, Wind, dryden_filter, dryden_scales

MODERATE = Wind(gusts=15.4, altitude=6.0, airspeed=3.0)
PERIOD = 0.02  # [s]


def sampled(wind, seed, duration):
    """Returns the outputs (3, n) [m/s] of a wind, every period."""
    builder = DiagramBuilder()
    source = builder.AddSystem(DrydenWind(wind, seed))
    log = LogVectorOutput(source.get_output_port(), builder, PERIOD)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(duration)
    return log.FindLog(simulator.get_context()).data()


def dryden_spectra(wind: Wind, frequency: np.ndarray) -> np.ndarray:
    lengths, sigmas = dryden_scales(wind)
    shape = (3, *[1] * np.ndim(frequency))
    T, variance = (lengths / wind.airspeed).reshape(shape), (sigmas**2).reshape(shape)
    square = (T * frequency) ** 2
    spectra = variance * T / np.pi * (1.0 + 3.0 * square) / (1.0 + square) ** 2
    spectra[0] = (variance * 2.0 * T / np.pi / (1.0 + square))[0]
    return spectra


def test_scales_are_those_of_the_specification():
    # At 1000 feet: level is 1, lengths are 1000 feet and deviations a tenth of the wind at 20 feet.
    lengths, sigmas = dryden_scales(Wind(gusts=10.0, altitude=304.8))
    np.testing.assert_allclose(lengths, 304.8, rtol=1e-3)
    np.testing.assert_allclose(sigmas, 1.0, rtol=1e-3)
    # At 20 feet, by hand.
    lengths, sigmas = dryden_scales(Wind(gusts=15.4, altitude=6.096))
    np.testing.assert_allclose(lengths, [43.77, 43.77, 6.096], rtol=2e-3)
    np.testing.assert_allclose(sigmas, [2.971, 2.971, 1.54], rtol=2e-3)


def test_the_filter_has_the_spectra_within_5_percent_over_three_decades():
    A, B, C, _ = dryden_filter(MODERATE, PERIOD)
    frequency = np.geomspace(0.035, 35.0, 301)  # [rad/s]; corners are at 0.07 to 0.5 rad/s
    z = np.exp(1j * frequency * PERIOD)
    gains = np.array([C @ np.linalg.solve(each * np.eye(5) - A, B) for each in z])
    spectra = PERIOD / math.pi * (np.abs(gains) ** 2).sum(2).T
    np.testing.assert_allclose(spectra, dryden_spectra(MODERATE, frequency), rtol=0.05)


def test_the_filter_is_stationary_from_its_start():
    A, B, C, start = dryden_filter(MODERATE, PERIOD)
    covariance = start @ start.T
    np.testing.assert_allclose(A @ covariance @ A.T + B @ B.T, covariance, atol=1e-12)
    variances = np.diag(C @ covariance @ C.T)
    np.testing.assert_allclose(variances, dryden_scales(MODERATE)[1] ** 2, rtol=1e-9)


def test_outputs_have_the_variance_about_the_mean_from_time_0():
    wind = replace(MODERATE, mean=[1.0, -2.0, 0.5], airspeed=30.0)
    sources = [DrydenWind(wind, seed) for seed in range(400)]
    first = np.array([each.get_output_port().Eval(each.CreateDefaultContext()) for each in sources])
    later = sampled(wind, 7, 100.0)
    sigmas = dryden_scales(wind)[1]
    for gusts, tolerance in ((first.T, 0.15), (later, 0.25)):
        np.testing.assert_allclose(gusts.std(axis=1), sigmas, rtol=tolerance)
        np.testing.assert_allclose(gusts.mean(axis=1), wind.mean, atol=0.3 * sigmas.max())


def test_a_seed_repeats_the_wind_whose_gusts_turn_with_its_mean():
    east, again, other, north = (
        sampled(replace(MODERATE, mean=mean), seed, 0.5) - np.array([mean]).T
        for seed, mean in ((3, [2.0, 0, 0]), (3, [2.0, 0, 0]), (4, [2.0, 0, 0]), (3, [0, 2.0, 0]))
    )
    np.testing.assert_array_equal(east, again)
    assert np.abs(east - other).max() > 0.1
    np.testing.assert_allclose(north, [-east[1], east[0], east[2]], atol=1e-12)


def test_numbers_are_parameters_of_the_context():
    source = DrydenWind(Wind(gusts=5.0))
    context = source.CreateDefaultContext()
    gusts = source.get_output_port().Eval(context)
    source.SetMean(context, [1.0, 2.0, 3.0])
    source.SetGusts(context, 10.0)
    np.testing.assert_allclose(source.get_output_port().Eval(context), 2 * gusts + [1, 2, 3])
    with pytest.raises(ValueError, match=r"Wind.gusts must be in .*, got -1"):
        source.SetGusts(context, -1.0)
    after = source.EvalUniquePeriodicDiscreteUpdate(source.CreateDefaultContext()).value()
    for converted in (source.ToAutoDiffXd(), source.ToSymbolic()):
        context = converted.CreateDefaultContext()
        following = converted.EvalUniquePeriodicDiscreteUpdate(context).value()
        found = [converted.get_output_port().Eval(context)[0], following[0]]
        found = [x.Evaluate() if isinstance(x, Expression) else x.value() for x in found]
        assert found == pytest.approx([gusts[0], after[0]])
