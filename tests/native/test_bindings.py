import numpy as np
import pytest

from splatpilot import _native

GRID = {
    "grid": np.ones((2, 2, 2), np.float32),
    "lower_W": np.zeros(3),
    "upper_W": np.ones(3),
    "voxel_size": 0.5,
    "occupied_outside": False,
    "p_WQ": np.full((1, 3), 0.5),
}
LOSS = {name: np.ones((1, 16, 16, 3), np.float32) for name in ("rendered", "target")}


@pytest.mark.parametrize(
    ("write", "out", "arguments"),
    [
        (_native.grid_distances, "distances", GRID),
        (_native.photometric_loss, "gradient", LOSS | {"ssim_weight": 0.2}),
        (
            _native.quadrotor_derivatives,
            "derivatives",
            {"state": np.eye(13)[6], "command": np.zeros(4), "drag": 0.1}
            | {"rate_time_constant": 0.1, "gravity": 9.81},
        ),
    ],
)
def test_outputs_of_another_type_are_refused_instead_of_copied(write, out, arguments):
    right = {"distances": np.empty(1), "derivatives": np.empty(13)}
    array = right.get(out, np.empty((1, 16, 16, 3), np.float32))
    write(**arguments, **{out: array})
    other = np.float32 if array.dtype == np.float64 else np.float64
    with pytest.raises(TypeError):
        write(**arguments, **{out: array.astype(other)})
