"""A flight diagram wired by hand: every system is added and connected by its port names.

    python examples/flight_by_hand.py

The vehicle flies through a forest to its goal. `sp.BuildFlightDiagram` wires the same loop from a
scenario; by hand, any system can be replaced by another one with the same ports.
"""

import argparse

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, EventStatus
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

import splatpilot as sp


def main(length: float, timeout: float) -> None:
    scenario = sp.load_config(sp.Scenario(), overrides=[f"world.length={length}"])
    world = sp.make_world(scenario.world, seed=1)

    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", sp.QuadrotorPlant())
    goal = builder.AddNamedSystem("goal", ConstantVectorSource(world.p_WG))
    planner = builder.AddNamedSystem("planner", sp.PrivilegedPlanner(world.esdf))
    selector = builder.AddNamedSystem("selector", sp.HypothesisSelector())
    controller = builder.AddNamedSystem("controller", sp.FlatnessController())
    collision = builder.AddNamedSystem("collision", sp.EsdfCollision(world.distance_field))
    pose = builder.AddNamedSystem("pose", sp.StateToPose())
    camera = builder.AddNamedSystem("camera", sp.MakeCamera(scenario, world))
    for system in (planner, selector, controller, collision, pose):
        builder.Connect(plant.GetOutputPort("state"), system.GetInputPort("state"))
    builder.Connect(goal.get_output_port(), planner.GetInputPort("goal"))
    builder.Connect(planner.GetOutputPort("hypotheses"), selector.GetInputPort("hypotheses"))
    builder.Connect(selector.GetOutputPort("waypoint"), controller.GetInputPort("waypoint"))
    builder.Connect(controller.GetOutputPort("command"), plant.GetInputPort("command"))
    builder.Connect(pose.GetOutputPort("pose"), camera.GetInputPort("body_pose"))
    log = LogVectorOutput(collision.GetOutputPort("clearance"), builder, 0.02)
    diagram = builder.Build()

    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    plant.GetMyMutableContextFromRoot(root).SetContinuousState(sp.hover_state(world.p_WS))

    def arrived(context) -> EventStatus:
        p_WB = plant.GetOutputPort("state").Eval(plant.GetMyContextFromRoot(context))[:3]
        if np.linalg.norm(world.p_WG - p_WB) > 0.3:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(diagram, "arrived")

    simulator.set_monitor(arrived)
    simulator.AdvanceTo(timeout)
    ended = "at the goal" if root.get_time() < timeout else "in flight"
    clearance = log.FindLog(root).data().min()
    print(f"After {root.get_time():.1f} s {ended}; minimum clearance {clearance:.2f} m.")
    # This renders the first image: cameras render when a port is evaluated.
    image = camera.GetOutputPort("color_image").Eval(camera.GetMyContextFromRoot(root)).data
    print(f"The camera sees {image.shape[1]}x{image.shape[0]} pixels, mean {image.mean():.0f}.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--length", type=float, default=24.0, help="of the forest [m]")
    parser.add_argument("--timeout", type=float, default=30.0, help="[s]")
    main(**vars(parser.parse_args()))
