"""Flights of vehicles other than the benchmark's, and in wind."""

import numpy as np
import pytest
from pydrake.common.schema import Uniform
from pydrake.systems.analysis import Simulator

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.policies import policy_named
from splatpilot.diagrams.flight.scenario import Scenario, sample_scenario
from splatpilot.systems.common.config import dump_config, load_config
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams
from splatpilot.systems.vehicle.vehicles import Kingfisher
from splatpilot.systems.vehicle.wind import Wind


def flown(post_world, **fields):
    """Returns the state after a second of flight from rest at the start."""
    scenario = Scenario(policy=policy_named("straight"), start_radius=0.0, **fields)
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.0)
    return np.asarray(diagram.GetOutputPort("state").Eval(simulator.get_context()))


def test_a_scenarios_wind_pushes_the_vehicle(post_world):
    calm = flown(post_world)
    np.testing.assert_array_equal(calm, flown(post_world, wind=Wind()))
    assert flown(post_world, wind=Wind(mean=[0.0, 4.0, 0.0]))[4] > calm[4] + 0.1
    gusty = [flown(post_world, wind=Wind(gusts=15.0), seed=seed) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(gusty[0], gusty[1])
    assert np.abs(gusty[0] - gusty[2])[3:6].max() > 0.05


def test_a_vehicle_is_chosen_by_its_tag_and_written_with_it():
    scenario = load_config(Scenario(), overrides=["vehicle=!Kingfisher {model: lags}"])
    assert scenario.vehicle == Kingfisher(model="lags")
    assert "vehicle: !Kingfisher" in dump_config(scenario)
    assert load_config(scenario, overrides=["vehicle.mass=0.8"]).vehicle.mass == 0.8
    plain = dump_config(Scenario())
    assert "!QuadrotorParams" not in plain


def test_a_fast_vehicle_needs_small_steps():
    scenario = Scenario(vehicle=QuadrotorParams(rate_time_constant=0.004))
    message = r"shortest time constant .* at least half of .*0.02 s.*, got 0.004 s; set .* 0.008"
    with pytest.raises(ValueError, match=message):
        scenario.validate()
    scenario.simulator.max_step_size = 0.008
    scenario.validate()


def test_fields_of_vehicle_and_wind_are_drawn(post_world):
    vehicle = Kingfisher(thrust_scale=Uniform(min=0.8, max=0.9))
    scenario = Scenario(vehicle=vehicle, wind=Wind(gusts=Uniform(min=5.0, max=10.0)))
    drawn = sample_scenario(scenario)
    assert 0.8 < drawn.vehicle.thrust_scale < 0.9 and 5.0 < drawn.wind.gusts < 10.0
    assert flown(post_world, vehicle=vehicle)[2] < flown(post_world, vehicle=Kingfisher())[2]


def test_the_vehicles_radius_decides_collisions(post_world):
    small, large = (
        BuildFlightDiagram(
            Scenario(policy=policy_named("straight"), vehicle=QuadrotorParams(radius=radius)),
            post_world,
            camera=False,
        )
        for radius in (0.1, 0.3)
    )
    clearances = [
        float(diagram.GetOutputPort("clearance").Eval(diagram.CreateDefaultContext())[0])
        for diagram in (small, large)
    ]
    assert clearances[0] - clearances[1] == pytest.approx(0.2)
