"""Drake's own quadrotor with a splat camera.

    python examples/drakes_quadrotor.py --out out/drakes_quadrotor.mp4

`pydrake.examples.QuadrotorPlant`, whose four inputs are forces of propellers, flies to a hover by
Drake's LQR and is filmed. The only input of `SplatCamera` is a pose, X_WB.
"""

import argparse
from pathlib import Path

import numpy as np
from pydrake.common.value import Value
from pydrake.examples import QuadrotorPlant, StabilizingLQRController
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

import splatpilot as sp
from splatpilot.systems.visualization.video import VideoRecorder


class PoseOfDrakesQuadrotor(LeafSystem):
    """Converts a state (12), position, roll, pitch, yaw and their derivatives, to X_WB."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("state", 12)
        self.DeclareAbstractOutputPort("pose", Value(RigidTransform()).Clone, self._calc)

    def _calc(self, context, output):
        state = self.get_input_port().Eval(context)
        output.set_value(RigidTransform(RollPitchYaw(state[3:6]), state[:3]))


def main(out: Path, seconds: float) -> None:
    scenario = sp.load_config(sp.Scenario(), overrides=["world.length=12"])
    world = sp.make_world(scenario.world, seed=0)
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant())
    p_WG = world.p_WS + np.array([1.5, 0.4, 0.0])
    controller = builder.AddSystem(StabilizingLQRController(plant, p_WG))
    pose = builder.AddSystem(PoseOfDrakesQuadrotor())
    camera = builder.AddSystem(sp.MakeCamera(scenario, world))
    builder.Connect(controller.get_output_port(), plant.get_input_port())
    builder.Connect(plant.get_output_port(), controller.get_input_port())
    builder.Connect(plant.get_output_port(), pose.get_input_port())
    builder.Connect(pose.get_output_port(), camera.GetInputPort("body_pose"))
    recorder = VideoRecorder.AddToBuilder(builder, camera, fps=scenario.camera.fps)
    simulator = Simulator(builder.Build())

    root = simulator.get_mutable_context()
    start = np.concatenate([world.p_WS, np.zeros(9)])
    plant.GetMyMutableContextFromRoot(root).SetContinuousState(start)
    simulator.AdvanceTo(seconds)
    recorder.save(out, scenario.camera.z_far)
    flown = plant.get_output_port().Eval(plant.GetMyContextFromRoot(root))[:3] - world.p_WS
    print(f"Wrote {out}; flown {np.round(flown, 2).tolist()} m.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("drakes_quadrotor.mp4"))
    parser.add_argument("--seconds", type=float, default=4.0)
    main(**vars(parser.parse_args()))
