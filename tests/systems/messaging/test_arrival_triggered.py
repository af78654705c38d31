import math

import numpy as np
import pytest
from harness import Harness
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from splatpilot.systems.messaging.arrival_triggered import ArrivalTriggered

PERIOD, TICK = 0.1, 0.002


class Policy(LeafSystem):
    """Keeps its last image, and counts; raises an exception in the method that `broken` names."""

    broken = ""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("image", 1)
        self.DeclareAbstractInputPort("label", Value(""))
        self.DeclareStateOutputPort("seen", self.DeclareDiscreteState(1))
        self.DeclareStateOutputPort("count", self.DeclareDiscreteState([0.0]))
        self.DeclareVectorOutputPort("double", 1, self._double, {self.xd_ticket()})
        self.DeclareVectorOutputPort("sum", 1, self._sum)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context, discrete_state):
        if self.broken == "update":
            raise RuntimeError("the network ran out of memory")
        discrete_state.set_value(0, self.GetInputPort("image").Eval(context))
        discrete_state.set_value(1, context.get_discrete_state(1).value() + 1.0)

    def _double(self, context, output):
        if self.broken == "output":
            raise ArithmeticError("the plan overflows")
        output[0] = 2.0 * context.get_discrete_state(0)[0]

    def _sum(self, context, output):
        output[0] = context.get_discrete_state(0)[0] + self.GetInputPort("image").Eval(context)[0]


def decisions(times: np.ndarray, until: float) -> np.ndarray:
    """Time and image of each decision (n, 2), by images that come 0.01 s after their times."""
    triggered, rows = Harness(ArrivalTriggered(Policy(), TICK)), [np.zeros(3)]
    for k in range(round(until / TICK)):
        last = int((times + 0.01 <= k * TICK + 1e-9).sum()) - 1
        age = math.inf if last < 0 else k * TICK - times[last]
        triggered.give(image=last, observation_age=age)
        triggered.simulator.AdvanceTo((k + 0.5) * TICK)
        rows.append([triggered.out(port) for port in ("decided", "seen", "count")])
    rows = np.array(rows)
    return rows[1:][np.diff(rows[:, 2]) > 0, :2]


def test_decides_as_images_come():
    made = decisions(0.037 + PERIOD * np.arange(10), 1.0)
    np.testing.assert_array_equal(made[:, 1], np.arange(10))
    late = made[:, 0] - (0.047 + PERIOD * np.arange(10))
    assert (late >= 0.0).all() and (late < TICK).all()


@pytest.mark.parametrize("faster", [1.33, 3.0])
def test_fast_images_do_not_make_it_faster(faster):
    made = decisions(PERIOD / faster * np.arange(120), 3.0)
    late = made[:, 0] - (made[:, 1] * PERIOD / faster + 0.01)
    assert late.max() < TICK
    assert 0.95 * PERIOD - TICK < np.mean(np.diff(made[1:, 0])) < 1.1 * PERIOD


@pytest.mark.parametrize("phase", [0.4, 0.8])
def test_images_that_change_their_phase_are_found_again(phase):
    jitter = 0.2 * PERIOD * np.random.default_rng(0).uniform(-1.0, 1.0, 40)
    times = PERIOD * (np.arange(40) + np.where(np.arange(40) < 20, 0.0, phase)) + 0.05 + jitter
    made = decisions(times, 4.0)
    for number in (*range(1, 19), *range(22, 38)):
        late = made[made[:, 1] == number, 0] - times[number] - 0.01
        assert len(late) == 1 and 0.0 <= late[0] < TICK


def test_without_images_it_continues():
    made = decisions(PERIOD * np.array([0, 1, 2, 3, 4, 10, 11, 12, 13, 14]), 1.5)
    missing = made[(made[:, 0] > 0.42) & (made[:, 0] < 1.0)]
    assert (missing[:, 1] == 4.0).all()
    np.testing.assert_allclose(np.diff(missing[:, 0]), 0.16, atol=1.01 * TICK)
    after = made[made[:, 1] >= 5.0]
    np.testing.assert_allclose(after[:, 0], PERIOD * np.arange(10, 15) + 0.01, atol=1.01 * TICK)


def test_outputs_are_the_systems():
    system = ArrivalTriggered(Policy(), TICK)
    triggered = Harness(system)
    triggered.context.SetDiscreteState(0, [3.0])
    assert triggered.out("double") == 6.0
    for image in (4.0, 5.0):
        triggered.give(image=image)
        assert triggered.out("sum") == 3.0 + image
    assert system.HasDirectFeedthrough(0, 3) and not system.HasDirectFeedthrough(0, 2)


@pytest.mark.parametrize(
    ("broken", "said"), [("update", "ran out of memory"), ("output", "the plan overflows")]
)
def test_an_exception_of_the_system_is_told_and_logged_once(caplog, broken, said):
    policy = Policy()
    triggered = Harness(ArrivalTriggered(policy, TICK), observation_age=0.0)

    def after(now: float, image: float) -> list[float]:
        triggered.give(image=image)
        triggered.simulator.AdvanceTo(now)
        return [triggered.out(port) for port in ("failed", "seen", "double")]

    assert after(0.3, 3.0) == [0.0, 3.0, 6.0]
    policy.broken = broken
    *state, double = after(0.9, 4.0)
    assert state == [1.0, 3.0]
    assert math.isnan(double) == (broken == "output")
    assert [said in record.exc_text for record in caplog.records] == [True]
    policy.broken = ""
    assert after(1.2, 4.0) == [0.0, 4.0, 8.0]
