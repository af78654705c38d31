"""Updates by what comes."""

import math

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from splatpilot.systems.messaging.arrival_triggered import ArrivalTriggered

PERIOD, TICK = 0.1, 0.002


class Policy(LeafSystem):
    """Ten times a second it keeps what it sees, and counts; its plan is the double of that."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("image", 1)
        self.DeclareAbstractInputPort("label", Value(""))
        self.DeclareStateOutputPort("seen", self.DeclareDiscreteState(1))
        count = self.DeclareDiscreteState([0.0])
        self.DeclareStateOutputPort("count", count)
        self.DeclareVectorOutputPort("double", 1, self._double, {self.xd_ticket()})
        self.DeclareVectorOutputPort("sum", 1, self._sum)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context, discrete_state):
        discrete_state.set_value(0, self.GetInputPort("image").Eval(context))
        discrete_state.set_value(1, context.get_discrete_state(1).value() + 1.0)

    def _double(self, context, output):
        output[0] = 2.0 * context.get_discrete_state(0)[0]

    def _sum(self, context, output):
        output[0] = context.get_discrete_state(0)[0] + self.GetInputPort("image").Eval(context)[0]


class Camera(LeafSystem):
    """Sends an image at each of its times, which comes `delay` [s] later; it bears its number."""

    def __init__(self, times: np.ndarray, delay: float = 0.01):
        super().__init__()
        self._times, self._delay = times, delay
        self.DeclareVectorOutputPort("image", 1, self._calc_image)
        self.DeclareVectorOutputPort("age", 1, self._calc_age)

    def _last(self, context) -> int:
        arrived = self._times + self._delay <= context.get_time() + 1e-9
        return int(arrived.sum()) - 1

    def _calc_image(self, context, output):
        output[0] = self._last(context)

    def _calc_age(self, context, output):
        last = self._last(context)
        output[0] = math.inf if last < 0 else context.get_time() - self._times[last]


def run(times: np.ndarray, until: float) -> np.ndarray:
    """Time of the last decision, image seen and number of decisions at each tick (n, 3)."""
    builder = DiagramBuilder()
    camera = builder.AddSystem(Camera(times))
    triggered = builder.AddSystem(ArrivalTriggered(Policy(), TICK))
    builder.Connect(camera.GetOutputPort("image"), triggered.GetInputPort("image"))
    builder.Connect(camera.GetOutputPort("age"), triggered.GetInputPort("observation_age"))
    simulator = Simulator(builder.Build())
    context = triggered.GetMyContextFromRoot(simulator.get_context())
    rows = []
    for k in range(round(until / TICK)):
        simulator.AdvanceTo(k * TICK + 0.5 * TICK)
        ports = ("decided", "seen", "count")
        rows.append([triggered.GetOutputPort(port).Eval(context)[0] for port in ports])
    return np.array(rows)


def decisions(rows: np.ndarray) -> np.ndarray:
    """Time and image of each decision (n, 2)."""
    return rows[np.append(True, np.diff(rows[:, 2]) > 0) & (rows[:, 2] > 0), :2]


def test_decides_as_images_come():
    rows = run(0.037 + PERIOD * np.arange(10), 1.0)
    made = decisions(rows)
    np.testing.assert_array_equal(made[:, 1], np.arange(10))
    late = made[:, 0] - (0.047 + PERIOD * np.arange(10))
    assert (late >= 0.0).all() and (late < TICK).all()
    assert rows[22, 2] == 0.0


@pytest.mark.parametrize("faster", [1.33, 2.0, 3.0])
def test_fast_images_do_not_make_it_faster(faster):
    made = decisions(run(PERIOD / faster * np.arange(400), 10.0))
    late = made[:, 0] - (made[:, 1] * PERIOD / faster + 0.01)
    assert late.max() < TICK
    assert 0.95 * PERIOD - TICK < np.mean(np.diff(made[1:, 0])) < 1.1 * PERIOD


@pytest.mark.parametrize("phase", [0.2, 0.4, 0.6, 0.8])
def test_images_that_change_their_phase_are_found_again(phase):
    jitter = 0.2 * PERIOD * np.random.default_rng(0).uniform(-1.0, 1.0, 60)
    times = PERIOD * (np.arange(60) + np.where(np.arange(60) < 20, 0.0, phase)) + 0.05 + jitter
    made = decisions(run(times, 6.0))
    for number in (*range(1, 19), *range(22, 58)):
        late = made[made[:, 1] == number, 0] - times[number] - 0.01
        assert len(late) == 1 and 0.0 <= late[0] < TICK


def test_without_images_it_goes_on():
    made = decisions(run(np.append(PERIOD * np.arange(5), PERIOD * np.arange(10, 15)), 1.5))
    missing = made[(made[:, 0] > 0.42) & (made[:, 0] < 1.0)]
    assert (missing[:, 1] == 4.0).all()
    np.testing.assert_allclose(np.diff(missing[:, 0]), 0.16, atol=1.01 * TICK)
    after = made[made[:, 1] >= 5.0]
    np.testing.assert_allclose(after[:, 0], PERIOD * np.arange(10, 15) + 0.01, atol=1.01 * TICK)


def test_outputs_are_the_systems():
    triggered = ArrivalTriggered(Policy(), TICK)
    context = triggered.CreateDefaultContext()
    context.SetDiscreteState(0, [3.0])
    assert triggered.GetOutputPort("double").Eval(context)[0] == 6.0
    triggered.GetInputPort("image").FixValue(context, [4.0])
    assert triggered.GetOutputPort("sum").Eval(context)[0] == 7.0
    triggered.GetInputPort("image").FixValue(context, [5.0])
    assert triggered.GetOutputPort("sum").Eval(context)[0] == 8.0
    assert triggered.HasDirectFeedthrough(0, 3) and not triggered.HasDirectFeedthrough(0, 2)


class Fragile(Policy):
    """A policy that raises an exception while `broken` says where."""

    broken = ""

    def _update(self, context, discrete_state):
        if self.broken == "update":
            raise RuntimeError("the network ran out of memory")
        super()._update(context, discrete_state)

    def _double(self, context, output):
        if self.broken == "output":
            raise ArithmeticError("the plan overflows")
        super()._double(context, output)


@pytest.mark.parametrize(
    ("broken", "said"), [("update", "ran out of memory"), ("output", "the plan overflows")]
)
def test_what_the_system_raises_is_told_and_logged_once(caplog, broken, said):
    policy = Fragile()
    triggered = ArrivalTriggered(policy, TICK)
    simulator = Simulator(triggered)
    context = simulator.get_mutable_context()
    triggered.GetInputPort("image").FixValue(context, [3.0])
    triggered.GetInputPort("observation_age").FixValue(context, [0.0])

    def out(name: str) -> float:
        return triggered.GetOutputPort(name).Eval(context)[0]

    simulator.AdvanceTo(0.3)
    assert (out("failed"), out("seen")) == (0.0, 3.0)
    policy.broken = broken
    triggered.GetInputPort("image").FixValue(context, [4.0])
    simulator.AdvanceTo(0.9)
    assert (out("failed"), out("seen")) == (1.0, 3.0)
    assert math.isnan(out("double")) == (broken == "output")
    assert [said in record.exc_text for record in caplog.records] == [True]
    policy.broken = ""
    simulator.AdvanceTo(1.2)
    assert (out("failed"), out("double")) == (0.0, 8.0)


def test_what_cannot_be_triggered_is_an_error():
    with pytest.raises(ValueError, match=r"what arrivals trigger must be .* got LeafSystem"):
        ArrivalTriggered(LeafSystem(), TICK)
