"""Signals without what is no number."""

import numpy as np
import pytest

from splatpilot.systems.messaging.failsafe import FiniteVector


@pytest.mark.parametrize(
    ("signal", "finite"),
    [([1.0, -2.0], [1.0, -2.0]), ([1.0, np.nan], [0.0, 0.0]), ([-np.inf, 0.0], [0.0, 0.0])],
)
def test_signal_is_whole_or_zero(signal, finite):
    """All numbers pass; with one that is none there are zeros."""
    system = FiniteVector(2)
    context = system.CreateDefaultContext()
    system.signal_input_port().FixValue(context, signal)
    np.testing.assert_array_equal(system.finite_output_port().Eval(context), finite)


def test_what_is_not_finite_becomes_the_substitute():
    system = FiniteVector(1, substitute=np.nan)
    context = system.CreateDefaultContext()
    for signal, finite in ((0.5, 0.5), (np.inf, np.nan), (np.nan, np.nan)):
        system.signal_input_port().FixValue(context, [signal])
        np.testing.assert_array_equal(system.finite_output_port().Eval(context), [finite])
