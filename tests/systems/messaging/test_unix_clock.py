"""Unix time in a Context."""

from splatpilot.systems.messaging.bridge_status import UnixClock


def test_unix_time_is_the_epoch_and_the_contexts_time():
    """To the microsecond, in our century."""
    clock = UnixClock()
    context = clock.CreateDefaultContext()
    clock.set_epoch(context, 1_800_000_000.125)
    context.SetTime(3600.000001)
    assert abs(clock.unix_time_output_port().Eval(context)[0] - 1_800_003_600.125001) < 5e-7
