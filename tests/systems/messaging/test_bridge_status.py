"""What is known of the messages that a vehicle is flown by."""

import numpy as np

from splatpilot.systems.messaging.bridge_status import BridgeStatus


def test_status_sums_up_the_signals():
    """Ages are those of the state and of the oldest image, counts those of all signals."""
    system = BridgeStatus(["depth_image_32f", "color_image"])
    context = system.CreateDefaultContext()
    values = {"age": (0.01, 0.05, 0.07), "gaps": (2.0, 3.0, 1.0), "rejected": (5.0, 7.0, 0.0)}
    for what, numbers in values.items():
        for signal, value in zip(("state", "depth_image_32f", "color_image"), numbers, strict=True):
            system.GetInputPort(f"{signal}_{what}").FixValue(context, [value])
    system.mode_input_port().FixValue(context, [2.0, 4.0])
    status = system.status_output_port().Eval(context)
    np.testing.assert_array_equal(status, [2, 4, 0.01, 0.07, 6, 12, 0])
    assert system.observation_age_output_port().Eval(context)[0] == 0.07


def test_policies_that_see_nothing_have_the_state_alone():
    """Without images their age is 0; overruns are passed on."""
    system = BridgeStatus([])
    context = system.CreateDefaultContext()
    for name in ("state_age", "state_gaps", "state_rejected"):
        system.GetInputPort(name).FixValue(context, [0.1])
    system.overruns_input_port().FixValue(context, [4.0])
    system.mode_input_port().FixValue(context, [1.0, 0.0])
    status = system.status_output_port().Eval(context)
    np.testing.assert_array_equal(status, [1, 0, 0.1, 0, 0.1, 0.1, 4])
    assert system.observation_age_output_port().Eval(context)[0] == 0.0
