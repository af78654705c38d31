"""What is known of the messages that a vehicle is flown by."""

import numpy as np
import pytest

from splatpilot.systems.messaging.bridge_status import BridgeStatus
from splatpilot.systems.messaging.generated import lcmt_bridge_status as lcmt


@pytest.mark.parametrize(
    ("state_age", "image_age", "mode"),
    [
        (0.01, 0.05, lcmt.FLYING),
        (0.3, 0.3, lcmt.FLYING),
        (0.31, 0.0, lcmt.STALE),
        (0.0, 0.31, lcmt.STALE),
        (np.inf, 0.0, lcmt.WAITING),
        (0.4, np.inf, lcmt.WAITING),
    ],
)
def test_commands_need_fresh_state_and_image(state_age, image_age, mode):
    """Only where both are fresh is anything commanded; counts are those of both."""
    system = BridgeStatus(["depth_image_32f"], max_age=0.3)
    context = system.CreateDefaultContext()
    values = {"age": (state_age, image_age), "gaps": (2.0, 3.0), "rejected": (5.0, 7.0)}
    for what, pair in values.items():
        for signal, value in zip(("state", "depth_image_32f"), pair, strict=True):
            system.GetInputPort(f"{signal}_{what}").FixValue(context, [value])
    status = system.status_output_port().Eval(context)
    np.testing.assert_array_equal(status, [mode, state_age, image_age, 5, 12, 0])
    assert system.enabled_output_port().Eval(context)[0] == (mode == lcmt.FLYING)


def test_policies_that_see_nothing_need_the_state_alone():
    """Without images their age is 0; overruns are passed on."""
    system = BridgeStatus([], max_age=0.3)
    context = system.CreateDefaultContext()
    for name in ("state_age", "state_gaps", "state_rejected"):
        system.GetInputPort(name).FixValue(context, [0.1])
    system.overruns_input_port().FixValue(context, [4.0])
    status = system.status_output_port().Eval(context)
    np.testing.assert_array_equal(status, [lcmt.FLYING, 0.1, 0, 0.1, 0.1, 4])
