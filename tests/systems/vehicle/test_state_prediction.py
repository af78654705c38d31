"""States brought up to date."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import AngleAxis, Quaternion

from splatpilot.systems.vehicle.state import QuadrotorState, StatePredictor, predict_state

NUMBERS = st.floats(-3, 3)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS).map(np.array)


@given(p=VECTORS, v=VECTORS, axis=VECTORS, w=VECTORS, duration=st.floats(0, 0.5))
def test_turns_and_moves_as_drakes_rotations_say(p, v, axis, w, duration):
    """The position moves on by velocity and the attitude turns about the body rates by their size
    times the duration; velocities stay."""
    q_WB = Quaternion(np.append(1.0, axis) / np.linalg.norm(np.append(1.0, axis)))
    state = np.concatenate([p, v, q_WB.wxyz(), w])
    later = QuadrotorState.of(predict_state(state, duration))
    np.testing.assert_allclose(later.p_WB, p + duration * v, atol=1e-12)
    np.testing.assert_array_equal(later.v_WB, v)
    np.testing.assert_array_equal(later.w_WB_B, w)
    rate = np.linalg.norm(w)
    axis = w / rate if rate > 1e-9 else np.array([1.0, 0.0, 0.0])
    turned = q_WB.multiply(AngleAxis(rate * duration, axis).quaternion()).wxyz()
    np.testing.assert_allclose(later.q_WB, turned, atol=1e-8)


@pytest.mark.parametrize(
    ("age", "moved"), [(0.0, 0.0), (0.05, 0.1), (0.5, 0.2), (-1.0, 0.0), (np.inf, 0.2)]
)
def test_ages_of_no_use_lead_nowhere(age, moved):
    """Negative ages count for nothing, long and infinite ones for the longest."""
    system = StatePredictor(longest=0.1)
    context = system.CreateDefaultContext()
    state = np.array([1.0, 0, 0, 2, 0, 0, 1, 0, 0, 0, 0, 0, 0])
    system.measured_state_input_port().FixValue(context, state)
    system.age_input_port().FixValue(context, [age])
    assert system.state_output_port().Eval(context)[0] == pytest.approx(1.0 + moved)
