import numpy as np
import pytest

from splatpilot.systems.messaging.lcm_ports import BridgeStatus, UnixClock


@pytest.mark.parametrize(
    ("images", "overruns", "status"),
    [
        (["depth_image_32f", "color_image"], None, [2, 4, 0.01, 0.07, 6, 12, 0]),
        ([], 4.0, [2, 4, 0.01, 0, 2, 5, 4]),
    ],
)
def test_status_sums_up_the_inputs(images, overruns, status):
    system = BridgeStatus(images)
    context = system.CreateDefaultContext()
    values = {"age": (0.01, 0.05, 0.07), "gaps": (2.0, 3.0, 1.0), "rejected": (5.0, 7.0, 0.0)}
    for what, numbers in values.items():
        for name, value in zip(["state", *images], numbers, strict=False):
            system.GetInputPort(f"{name}_{what}").FixValue(context, [value])
    system.GetInputPort("mode").FixValue(context, [2.0, 4.0])
    if overruns is not None:
        system.GetInputPort("overruns").FixValue(context, [overruns])
    np.testing.assert_array_equal(system.GetOutputPort("status").Eval(context), status)
    assert system.GetOutputPort("observation_age").Eval(context)[0] == status[3]


def test_unix_time_is_the_epoch_and_the_contexts_time():
    clock = UnixClock()
    context = clock.CreateDefaultContext()
    clock.set_epoch(context, 1_800_000_000.125)
    context.SetTime(3600.000001)
    assert abs(clock.GetOutputPort("unix_time").Eval(context)[0] - 1_800_003_600.125001) < 5e-7
