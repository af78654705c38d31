"""Flights that measure a policy while it learns."""

import pytest
import torch

from splatpilot.training.policies.evaluation import FlightConditions, Outcomes, evaluate_agent
from splatpilot.training.policies.image_noise import training_noise
from splatpilot.training.policies.ray_casting import PixelRays
from splatpilot.training.policies.training_worlds import WorldSelection, validation_worlds

WORLDS = WorldSelection(kinds=["P01"], held_out=7)


class Straight:
    """Flies to the goal at the speed that is asked."""

    rate = 15.0
    rays = PixelRays.of(4, 3, 90.0)

    def __init__(self) -> None:
        self.speeds: list[torch.Tensor] = []

    def initial_memory(self, count):
        return torch.zeros(count, 0)

    def decide(self, seen, memory):
        self.speeds.append(seen.speed)
        way = torch.nn.functional.normalize(seen.p_WG - seen.vehicle.p, dim=1)
        return 3.0 * (way * seen.speed[:, None] - seen.vehicle.v), None, memory


def test_each_speed_is_flown_in_as_many_worlds():
    """Of seven worlds and three speeds, none has less than two nor more than three; each flight
    goes at its own, and the same seed draws the same."""
    agent = Straight()
    worlds = validation_worlds(WORLDS)
    outcomes = evaluate_agent(agent, worlds, FlightConditions(), training_noise())
    asked = agent.speeds[0]
    counts = [(asked == speed).sum().item() for speed in (2.0, 3.0, 4.0)]
    assert sorted(counts) == [2, 2, 3]
    assert torch.equal(outcomes.wanted_speed, asked)
    assert outcomes.mean_speed[asked == 4.0].min() > outcomes.mean_speed[asked == 2.0].max()
    again = Straight()
    evaluate_agent(again, worlds, FlightConditions(), training_noise())
    assert torch.equal(again.speeds[0], asked)


def test_success_is_told_apart_by_speed_and_kind():
    """Four flights of two kinds and speeds, of which three arrive."""
    reached = torch.tensor([True, True, True, False])
    zero, speed = torch.zeros(4), torch.tensor([2.0, 2.0, 4.0, 4.0])
    measures = Outcomes(reached, ~reached, zero, zero, zero, speed).measures(["P01", "P02"])
    assert measures["success"] == 0.75 and measures["collisions"] == 0.25
    assert (measures["2 m/s"], measures["4 m/s"]) == (1.0, 0.5)
    assert (measures["P01"], measures["P02"]) == (1.0, 0.5)


@pytest.mark.parametrize("speeds", [[], [2.0, 0.0], [11.0]])
def test_speeds_out_of_range_are_refused(speeds):
    with pytest.raises(ValueError, match=r"validation.speeds is \[.*0.1 to 10 m/s"):
        FlightConditions(speeds=speeds).validate()
