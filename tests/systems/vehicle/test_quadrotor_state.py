"""The named parts of a quadrotor's state."""

import numpy as np
import pytest
import torch
from pydrake.autodiffutils import InitializeAutoDiff
from pydrake.symbolic import MakeVectorContinuousVariable, Variable
from scipy.spatial.transform import Rotation

from splatpilot.systems.vehicle.state import QuadrotorState


def test_parts_are_where_the_plant_has_them():
    """The parts of one state and of many are entries 0-2, 3-5, 6-9 and 10-12, and give it back."""
    for x in (np.arange(13.0), np.arange(2 * 3 * 13.0).reshape(2, 3, 13)):
        state = QuadrotorState.of(x)
        np.testing.assert_array_equal(state.p_WB, x[..., [0, 1, 2]])
        np.testing.assert_array_equal(state.v_WB, x[..., [3, 4, 5]])
        np.testing.assert_array_equal(state.q_WB, x[..., [6, 7, 8, 9]])
        np.testing.assert_array_equal(state.w_WB_B, x[..., [10, 11, 12]])
        np.testing.assert_array_equal(state.to_vector(), x)


@pytest.mark.parametrize("zeros", [np.zeros, torch.zeros])
def test_parts_are_views(zeros):
    """What is written to a part is written to the states."""
    x = zeros((2, 13))
    QuadrotorState.of(x).v_WB[:, 1] = 3.0
    assert x[:, 4].tolist() == [3.0, 3.0] and x.sum() == 6.0


def test_parts_of_derivatives_and_expressions():
    """Arrays of AutoDiffXd and of Expression have parts, and those pack, as floats do."""
    x = InitializeAutoDiff(np.arange(13.0)).ravel()
    packed = QuadrotorState.of(x).to_vector()
    assert [component.value() for component in packed] == list(range(13))
    np.testing.assert_array_equal(packed[7].derivatives(), np.eye(13)[7])
    variables: list[Variable] = MakeVectorContinuousVariable(13, "x").tolist()
    q_WB = QuadrotorState.of(np.array(variables)).q_WB
    assert [str(component) for component in q_WB] == ["x(6)", "x(7)", "x(8)", "x(9)"]


def test_heading_is_that_of_body_x_seen_from_above():
    rotations = Rotation.random(20, random_state=0)
    states = np.zeros((20, 13))
    states[:, 6:10] = rotations.as_quat(scalar_first=True)
    x_W = rotations.apply([1.0, 0.0, 0.0])
    expected = np.arctan2(x_W[:, 1], x_W[:, 0])
    np.testing.assert_allclose(QuadrotorState.of(states).heading, expected, atol=1e-12)


def test_other_shapes_are_refused():
    """What has not 13 numbers is no state."""
    with pytest.raises(ValueError, match=r"shape \(13, 2\); it must be \(\.\.\., 13\)"):
        QuadrotorState.of(np.zeros((13, 2)))
