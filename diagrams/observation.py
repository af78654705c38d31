"""What a policy sees: its camera, and what is between the camera and the policy."""

from pydrake.systems.framework import DiagramBuilder, OutputPort, System

from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.sensing.color_noise import ColorNoise
from splatpilot.systems.sensing.delayed_pose import DelayedPose
from splatpilot.systems.sensing.depth_noise import DepthNoise
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.splat_camera import SplatCamera


def camera_of(scenario: Scenario) -> OnboardCamera | None:
    """The camera of the scenario's policy; None of a policy that does not see."""
    return getattr(scenario.policy, "camera", None)


def AddObservation(
    builder: DiagramBuilder,
    scenario: Scenario,
    world: World,
    gaussians: BakedScene,
    state: OutputPort,
    pose: OutputPort,
    policy: System,
) -> None:
    """
    Adds the camera of a policy that sees, as `policy_camera`, and connects the policy to it.

    It renders when the policy looks. Where the scenario asks for them, `delayed_pose` makes its
    images late, and `depth_noise` or `color_noise` noisy.
    """
    config, noise = camera_of(scenario), scenario.observation
    if config is None:
        return
    camera = builder.AddNamedSystem(
        "policy_camera",
        SplatCamera(
            gaussians,
            config.camera_info(),
            config.X_BC(),
            min_depth=config.min_depth,
            max_depth=config.max_depth,
            background=world.background,
        ),
    )
    if noise.latency > 0.0:
        delayed = builder.AddNamedSystem("delayed_pose", DelayedPose(noise.latency))
        builder.Connect(state, delayed.GetInputPort("state"))
        pose = delayed.GetOutputPort("pose")
    builder.Connect(pose, camera.GetInputPort("body_pose"))
    for port, name, kind, active in (
        ("depth_image_32f", "depth_noise", DepthNoise, noise.changes_depth),
        ("color_image", "color_noise", ColorNoise, noise.changes_color),
    ):
        if not policy.HasInputPort(port):
            continue
        image = camera.GetOutputPort(port)
        if active:
            system = kind(noise, config, scenario.policy.rate, scenario.seed)
            builder.AddNamedSystem(name, system)
            builder.Connect(image, system.get_input_port())
            image = system.get_output_port()
        builder.Connect(image, policy.GetInputPort(port))
