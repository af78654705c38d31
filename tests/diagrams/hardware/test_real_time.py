import time

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from splatpilot.diagrams.hardware.real_time import MAX_LAG, run_in_real_time
from splatpilot.systems.messaging.lcm_ports import UnixClock


class Worker(LeafSystem):
    """Updates every 0.01 s, and needs some time for the update at 0.05 s."""

    def __init__(self, needs: float):
        super().__init__()
        self._needs = needs
        self.DeclareVectorInputPort("overruns", 1)
        self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.0, self._update)

    def _update(self, context, state) -> None:
        if abs(context.get_time() - 0.05) < 1e-9:
            time.sleep(self._needs)
        state.set_value(context.get_discrete_state(0).value() + 1)


def ran(needs: float):
    """Missing updates, overruns as returned and as input, duration, and the clock's final error."""
    builder = DiagramBuilder()
    clock = builder.AddNamedSystem("clock", UnixClock())
    worker = builder.AddSystem(Worker(needs))
    builder.ExportInput(worker.get_input_port(), "overruns")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    diagram.GetInputPort("overruns").FixValue(root, np.zeros(1))
    started, looked = [], []

    def over(now: float) -> bool:
        looked.append(now)
        return now >= 0.2 - 1e-9

    ready = lambda: started.append(time.monotonic())  # noqa: E731
    overruns = run_in_real_time(simulator, diagram, 0.01, over, ready)
    took = time.monotonic() - started[0]
    unix = clock.get_output_port().Eval(clock.GetMyContextFromRoot(root))[0]
    inside = worker.GetMyContextFromRoot(root)
    reported = worker.get_input_port().Eval(inside)[0]
    missing = round(looked[-1] / 0.01) + 1 - inside.get_discrete_state(0).value()[0]
    return missing, overruns, reported, took, time.time() - unix


@pytest.mark.parametrize("needs", [0.0, 0.03, 0.4])
def test_no_tick_begins_early_and_overruns_are_counted_and_leave_nothing_out(needs):
    missing, overruns, reported, took, behind = ran(needs)
    assert missing == 0
    assert overruns == reported >= (needs > 0.0)
    assert took >= max(0.2, needs + 0.15 - MAX_LAG)
    # Lag beyond the limit has been left behind: only waiting remains.
    assert not needs or -1e-3 <= behind <= MAX_LAG + 0.1
