"""LQR about hover: the quadrotor is a Drake plant, so Drake linearizes it and finds the gains.

    python examples/lqr_hover.py

`LinearQuadraticRegulator` differentiates the plant at rest by AutoDiffXd, and returns a controller
that replaces `FlatnessController`. The plant pulls its quaternion to unit length, so that the
uncontrollable direction is stable.
"""

import argparse

import numpy as np
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import LinearQuadraticRegulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput

import splatpilot as sp
from splatpilot.systems.vehicle.quadrotor import GRAVITY


def main(seconds: float) -> None:
    plant = sp.QuadrotorPlant()
    p_WG = np.array([0.0, 0.0, 1.5])
    at_rest = plant.CreateDefaultContext()
    at_rest.SetContinuousState(sp.hover_state(p_WG))
    plant.get_input_port().FixValue(at_rest, [GRAVITY, 0.0, 0.0, 0.0])

    # State: position, velocity, quaternion, body rates. Command: thrust over mass, body rates.
    Q = np.diag([10.0] * 3 + [1.0] * 3 + [1.0] * 4 + [0.1] * 3)
    R = np.diag([0.1, 1.0, 1.0, 1.0])

    builder = DiagramBuilder()
    builder.AddNamedSystem("plant", plant)
    controller = builder.AddNamedSystem("lqr", LinearQuadraticRegulator(plant, at_rest, Q, R))
    builder.Connect(plant.get_output_port(), controller.get_input_port())
    builder.Connect(controller.get_output_port(), plant.get_input_port())
    log = LogVectorOutput(plant.get_output_port(), builder, 0.02)
    simulator = Simulator(builder.Build())

    # A meter away, moving, tilted by 30 degrees, with a heading of 40 degrees.
    state = sp.hover_state(p_WG + np.array([1.0, -0.5, 0.3]))
    state[3:6] = [0.0, 1.0, 0.0]
    state[6:10] = RollPitchYaw(np.deg2rad([30.0, 0.0, 40.0])).ToQuaternion().wxyz()
    root = simulator.get_mutable_context()
    plant.GetMyMutableContextFromRoot(root).SetContinuousState(state)
    simulator.AdvanceTo(seconds)

    data = log.FindLog(root)
    distance = np.linalg.norm(data.data()[:3].T - p_WG, axis=1)
    late = data.sample_times()[np.flatnonzero(distance > 0.05)[-1]]
    print(f"Within 5 cm of the hover from {late:.2f} s on, {1e3 * distance[-1]:.2f} mm at last.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    main(**vars(parser.parse_args()))
