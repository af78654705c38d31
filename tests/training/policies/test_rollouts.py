import pytest
import torch

from splatpilot.training.policies.augmentation import depth_noise
from splatpilot.training.policies.ray_casting import PixelRays
from splatpilot.training.policies.rollouts import FlightConditions, Outcomes, evaluate_agent
from splatpilot.training.policies.training_worlds import WorldSelection, validation_worlds

WORLDS = WorldSelection(kinds=["P01"], held_out=7)


class Straight:
    rate = 15.0
    rays = PixelRays.of(4, 3, 90.0)

    def __init__(self) -> None:
        self.speeds: list[torch.Tensor] = []

    def initial_memory(self, count):
        return torch.zeros(count, 0)

    def decide(self, seen, memory):
        self.speeds.append(seen.speed)
        direction = torch.nn.functional.normalize(seen.p_WG - seen.vehicle.p, dim=1)
        return 3.0 * (direction * seen.speed[:, None] - seen.vehicle.v), None, memory


def test_each_speed_is_flown_in_as_many_worlds():
    agent = Straight()
    worlds = validation_worlds(WORLDS)
    outcomes = evaluate_agent(agent, worlds, FlightConditions(), depth_noise())
    speeds = agent.speeds[0]
    counts = [(speeds == speed).sum().item() for speed in (2.0, 3.0, 4.0)]
    assert sorted(counts) == [2, 2, 3]
    assert torch.equal(outcomes.nominal_speed, speeds)
    assert outcomes.mean_speed[speeds == 4.0].min() > outcomes.mean_speed[speeds == 2.0].max()
    again = Straight()
    evaluate_agent(again, worlds, FlightConditions(), depth_noise())
    assert torch.equal(again.speeds[0], speeds)


def test_success_is_listed_by_speed_and_kind():
    reached = torch.tensor([True, True, True, False])
    zero, speed = torch.zeros(4), torch.tensor([2.0, 2.0, 4.0, 4.0])
    metrics = Outcomes(reached, ~reached, zero, zero, zero, speed).metrics(["P01", "P02"])
    assert metrics["success"] == 0.75 and metrics["collisions"] == 0.25
    assert (metrics["2 m/s"], metrics["4 m/s"]) == (1.0, 0.5)
    assert (metrics["P01"], metrics["P02"]) == (1.0, 0.5)


@pytest.mark.parametrize("speeds", [[], [2.0, 0.0], [11.0]])
def test_speeds_out_of_range_are_refused(speeds):
    with pytest.raises(ValueError, match=r"FlightConditions.speeds must be .*, got \["):
        FlightConditions(speeds=speeds).validate()
