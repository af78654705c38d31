"""The flight diagram, cut in two: vehicle and bridge exchange messages."""

from dataclasses import replace

import lcm
import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.hardware.bridge import BuildHardwareDiagram, HardwareConfig
from splatpilot.diagrams.hardware.vehicle import BuildVehicleDiagram
from splatpilot.systems.common.drake import vector_output
from splatpilot.systems.messaging.lcm_ports import PUBLISH_OFFSET

TICK = 0.005  # [s]


class Halves:
    """Vehicle and bridge, whose time is two ticks behind; the test advances both."""

    def __init__(
        self, scenario: Scenario, world, vehicle: Scenario | None = None, policy=None, **fields
    ):
        self.lcm = lcm.LCM("memq://")
        self.heard = heard = []  # The callback must not keep the diagrams alive.
        self.lcm.subscribe("BODY_RATE_COMMAND", lambda _, data: heard.append(data))
        config = replace(HardwareConfig(), **{"tick": TICK} | fields)
        self.tick_period = config.tick
        self.vehicle = BuildVehicleDiagram(vehicle or scenario, world, self.lcm, config)
        self.hardware = BuildHardwareDiagram(scenario, world, self.lcm, config, policy=policy)
        self.simulators = [Simulator(self.vehicle), Simulator(self.hardware)]
        ApplySimulatorConfig(scenario.simulator, self.simulators[0])
        self.vehicle_root, self.root = (s.get_mutable_context() for s in self.simulators)
        plant = self.vehicle.GetSubsystemByName("plant")
        start = sample_initial_state(scenario, world)
        plant.GetMyMutableContextFromRoot(self.vehicle_root).SetContinuousState(start)
        clock = self.hardware.GetSubsystemByName("clock")
        clock.set_epoch(self.root, 2 * self.tick_period)
        self.tick = 0

    def advance_to(self, time: float, vehicle: bool = True) -> None:
        while self.tick * self.tick_period <= time + 1e-9:
            now = self.tick * self.tick_period + 2 * PUBLISH_OFFSET
            if vehicle:
                self.simulators[0].AdvanceTo(now)
            self.simulators[1].AdvanceTo(max(now - 2 * self.tick_period, 2 * PUBLISH_OFFSET))
            self.tick += 1

    def state(self) -> np.ndarray:
        return vector_output(self.vehicle, "state", self.vehicle_root)

    def out(self, name: str) -> np.ndarray:
        """An output of the bridge."""
        return vector_output(self.hardware, name, self.root)

    def mode(self) -> tuple[float, float]:
        return tuple(self.out("status")[:2])
