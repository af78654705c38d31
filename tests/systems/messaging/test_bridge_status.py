"""BridgeStatus and UnixClock."""

import numpy as np

from splatpilot.systems.messaging.bridge_status import BridgeStatus, UnixClock


def test_status_sums_up_the_signals():
    system = BridgeStatus(["depth_image_32f", "color_image"])
    context = system.CreateDefaultContext()
    values = {"age": (0.01, 0.05, 0.07), "gaps": (2.0, 3.0, 1.0), "rejected": (5.0, 7.0, 0.0)}
    for what, numbers in values.items():
        for signal, value in zip(("state", "depth_image_32f", "color_image"), numbers, strict=True):
            system.GetInputPort(f"{signal}_{what}").FixValue(context, [value])
    system.GetInputPort("mode").FixValue(context, [2.0, 4.0])
    status = system.GetOutputPort("status").Eval(context)
    np.testing.assert_array_equal(status, [2, 4, 0.01, 0.07, 6, 12, 0])
    assert system.GetOutputPort("observation_age").Eval(context)[0] == 0.07


def test_policies_that_see_nothing_have_the_state_alone():
    system = BridgeStatus([])
    context = system.CreateDefaultContext()
    for name in ("state_age", "state_gaps", "state_rejected"):
        system.GetInputPort(name).FixValue(context, [0.1])
    system.GetInputPort("overruns").FixValue(context, [4.0])
    system.GetInputPort("mode").FixValue(context, [1.0, 0.0])
    status = system.GetOutputPort("status").Eval(context)
    np.testing.assert_array_equal(status, [1, 0, 0.1, 0, 0.1, 0.1, 4])
    assert system.GetOutputPort("observation_age").Eval(context)[0] == 0.0


def test_unix_time_is_the_epoch_and_the_contexts_time():
    clock = UnixClock()
    context = clock.CreateDefaultContext()
    clock.set_epoch(context, 1_800_000_000.125)
    context.SetTime(3600.000001)
    assert abs(clock.GetOutputPort("unix_time").Eval(context)[0] - 1_800_003_600.125001) < 5e-7
