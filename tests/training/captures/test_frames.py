import numpy as np
import pytest

from splatpilot.training.captures.frames import existing_file, pose_from_matrix

MATRIX = np.array(
    [[0.0, 0.0, 1.0, 4.0], [1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.0, 6.0], [0.0, 0.0, 0.0, 1.0]]
)


@pytest.mark.parametrize("matrix", [MATRIX, MATRIX[:3]], ids=["4x4", "3x4"])
def test_pose_is_read_from_rows(matrix):
    X = pose_from_matrix(matrix, "here")
    np.testing.assert_allclose(X.GetAsMatrix34(), MATRIX[:3], atol=1e-15)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (MATRIX.T, r"here: the last row .* got \[4\.0, 5\.0, 6\.0, 1\.0\]; .* column by column"),
        (MATRIX + np.eye(4)[3], r"here: the last row of a pose must be 0 0 0 1, .*; copy it again"),
        (np.where(MATRIX == 4, np.nan, MATRIX), "here: the pose is not finite"),
        (2 * MATRIX[:3], "here: the rotation must be"),
    ],
    ids=["column by column", "another last row", "not finite", "not a rotation"],
)
def test_matrix_that_is_not_a_pose_is_refused(matrix, message):
    with pytest.raises(ValueError, match=message):
        pose_from_matrix(matrix, "here")


@pytest.mark.parametrize(
    ("written", "stored"),
    [("images\\a.png", "images/a.png"), ("images/küche.png", "images/ku\u0308che.png")],
)
def test_names_of_other_systems_are_found(tmp_path, written, stored):
    (tmp_path / "images").mkdir()
    (tmp_path / stored).touch()
    assert existing_file(tmp_path / written) == tmp_path / stored
    assert existing_file(tmp_path / "b.png") == tmp_path / "b.png"
