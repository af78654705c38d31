import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.vehicle.state import StateToPose


def pose_of(state):
    system = StateToPose()
    context = system.CreateDefaultContext()
    system.GetInputPort("state").FixValue(context, state)
    X_WB = system.GetOutputPort("pose").Eval(context)
    assert isinstance(X_WB, RigidTransform)
    return X_WB


@given(q=st.lists(st.floats(-2, 2), min_size=4, max_size=4))
def test_pose_has_the_position_and_the_attitude_of_the_normalised_quaternion(q):
    """Any nonzero quaternion gives the rotation scipy gives it, beside the position."""
    assume(np.linalg.norm(q) > 1e-6)
    state = np.arange(13.0)
    state[6:10] = q
    X_WB = pose_of(state)
    np.testing.assert_array_equal(X_WB.translation(), [0.0, 1.0, 2.0])
    expected = Rotation.from_quat(q, scalar_first=True).as_matrix()
    np.testing.assert_allclose(X_WB.rotation().matrix(), expected, atol=1e-12)


@pytest.mark.parametrize("w", [0.0, math.nan, math.inf])
def test_a_quaternion_that_is_no_rotation_is_an_error(w):
    """Zero and non-finite quaternions are refused with their value and the remedy."""
    state = hover_state([0.0, 0.0, 0.0])
    state[6] = w
    with pytest.raises(ValueError, match=f"q_WB = \\[{w}, .*set entries 6 to 9"):
        pose_of(state)
