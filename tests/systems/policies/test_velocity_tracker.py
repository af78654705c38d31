"""What takes up velocities."""

import numpy as np

from splatpilot.systems.policies.velocity import VelocityTracker


def test_velocities_are_approached_in_four_tenths_of_a_second():
    """The acceleration is the difference over 0.4 s, in its direction, and 6 m/s^2 at most."""
    system = VelocityTracker()
    context = system.CreateDefaultContext()
    state = np.array([9.0, 9, 9, 1, 0, -1, 1, 0, 0, 0, 0, 0, 0])
    system.state_input_port().FixValue(context, state)
    for wanted, expected in (([2, 1, -1], [2.5, 2.5, 0]), ([1, 0, 7], [0, 0, 6])):
        system.velocity_input_port().FixValue(context, np.array(wanted, dtype=float))
        found = system.acceleration_output_port().Eval(context)
        np.testing.assert_allclose(found, expected, atol=1e-12)
