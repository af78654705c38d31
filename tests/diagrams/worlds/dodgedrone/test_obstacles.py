"""The obstacles of the DodgeDrone challenge, beside lists that came with it."""

import numpy as np
import pytest

from splatpilot.diagrams.worlds.dodgedrone import LEVELS, Group, draw_obstacles

# Rows of obstacle lists that are stored with the challenge's simulator (uzh-rpg/flightmare) and
# forks of it: number of the obstacle, diameter [m], first centre [m] (1000: it is kept away).
PUBLISHED_SEED = 20220301
STORED = {
    ("easy", 22529): [
        (0, 1.7092899476763004, (4.63952056641906, -5.669700374657429, 4.333575990782115)),
        (60, 1.0074286771858323, (1000.0, 1000.0, 1000.0)),
        (75, 1.095048622646453, (46.43698659211582, -5.068729651353023, 3.173808134847701)),
        (76, 0.9704756573088047, (52.43208694297301, -1.2559707642461375, 0.6307071555626236)),
        (80, 1.4703259662669832, (1000.0, 1000.0, 1000.0)),
        (84, 1.1274644423671938, (44.98057081303121, 4.810357990896751, 2.181186728448353)),
    ],
    ("medium", PUBLISHED_SEED): [
        (0, 2.8574085013056156, (2.8628633632612543, 8.823789133799902, 1.455250136812437)),
        (49, 2.9068857719858627, (36.5220888384209, 7.897080252874645, 6.291612455700655)),
    ],
    ("medium", 27469): [
        (384, 0.5150307511451736, (43.147159260328216, 3.8491098675457973, 6.525908735571837)),
        (393, 1.680534780989849, (53.90344772331034, -1.4156632937504838, 2.443427826879975)),
        (567, 0.7403640039883492, (48.25723319125896, 6.761134614740257, 6.3109708931715875)),
        (595, 1.167627200017915, (1000.0, 1000.0, 1000.0)),
        (599, 1.4018272441167043, (53.69509398342851, 5.8699792077346675, 4.516849228330558)),
    ],
    ("hard", 8623): [
        (0, 1.4466261137353964, (9.334681554236099, -5.576885046307531, 4.360361731106545)),
        (180, 2.529270518053433, (1000.0, 1000.0, 1000.0)),
        (245, 2.9122117792950095, (23.720581006611763, -4.896477984525067, 9.411625722069363)),
        (246, 1.0116368357684637, (17.772277793823278, 3.3030033374579926, 5.832188507731959)),
        (247, 2.517175435121159, (58.68833358027551, -7.42572348703288, 7.768426684163321)),
        (372, 1.9624922717407005, (1000.0, 1000.0, 1000.0)),
        (377, 1.231173166264126, (5.140990892698268, 2.729136063679178, 9.635157535887496)),
        (378, 0.7914929684780745, (34.434292120817815, 2.465347946075196, 9.196069921085115)),
        (387, 1.1467741748744469, (1000.0, 1000.0, 1000.0)),
        (728, 0.9483730106447612, (54.3655575064444, -2.5770026572890647, 9.16597038382254)),
        (736, 1.1958694395759404, (1000.0, 1000.0, 1000.0)),
        (755, 1.050068975131838, (53.55140593558972, -2.0286958992173734, 3.615433142021099)),
    ],
}


@pytest.mark.parametrize(("level", "seed"), STORED)
def test_agrees_with_the_stored_lists(level, seed):
    """From seed and level come the diameters and first places of the challenge's own lists, to the
    last digit that both have."""
    obstacles = draw_obstacles(LEVELS[level], seed)
    for number, diameter, place in STORED[level, seed]:
        obstacle = obstacles[number]
        assert 2 * obstacle.radius == pytest.approx(diameter, rel=1e-14)
        first = np.where(np.isinf(obstacle.path[0]), 1000.0, obstacle.path[0])
        np.testing.assert_allclose(first, place, rtol=1e-13)


def test_an_accelerated_path_agrees_with_the_stored_one():
    """All of a path that came with the simulator: 71 rows until it leaves its region, of an
    obstacle behind 88 others that move and 988 that stand."""
    flat = (0.0, -10.0, 0.0), (60.0, 10.0, 10.0)
    third = (40.0, -10.0, 0.0), (60.0, 10.0, 10.0)
    groups = (
        Group(744, *flat, (0.1, 3.0)),
        Group(88, (20.0, -10.0, 0.0), (60.0, 10.0, 10.0), (0.5, 2.0), (5.0, 5.0, 2.0)),
        Group(244, *third, (0.1, 3.0)),
        Group(44, *third, (0.5, 1.5), (1.0, 1.0, 1.0), 30.0),
    )
    obstacle = draw_obstacles(groups, PUBLISHED_SEED)[744 + 88 + 244 + 40]
    assert 2 * obstacle.radius == pytest.approx(1.3379624605997786, rel=1e-14)
    assert len(obstacle.path) == 71
    stored = {
        0: (4.557431555988881655e01, -3.916509373218442391, 9.087675706341988402),
        1: (4.555421826652278128e01, -3.931329038348782667, 9.089614485060415916),
        35: (4.340031645496776491e01, -5.966700456254084628, 8.873795197671718427),
        70: (4.155339438602842250e01, -9.957823933506649183, 8.570482101580431333),
    }
    for row, place in stored.items():
        np.testing.assert_allclose(obstacle.path[row], place, rtol=1e-12)


@pytest.mark.parametrize("level", LEVELS)
def test_nothing_is_near_start_and_target(level):
    """At no time does the centre of an obstacle lie in the boxes that are kept free, nor does one
    that moves leave its region but by its first step."""
    for obstacle in draw_obstacles(LEVELS[level], 3):
        x, y, z = obstacle.path.T
        near = (abs(y) < 3) & (z > 0) & (z < 5)
        assert not (near & ((abs(x) < 3) | (abs(x - 59) < 2))).any()
        there = obstacle.path[1:][np.isfinite(obstacle.path[1:]).all(axis=1)]
        assert (there >= [0, -10, 0]).all() and (there <= [60, 10, 10]).all()
