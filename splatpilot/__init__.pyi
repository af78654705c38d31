from .diagrams.flight import Flight, Outcome, fly
from .diagrams.flight_diagram import BuildFlightDiagram, MakeCamera
from .diagrams.flight_start import sample_initial_state
from .diagrams.policies import policy_named, register_policy
from .diagrams.random_flights import random_flights
from .diagrams.scenario import Scenario
from .diagrams.sensors import register_sensor
from .diagrams.worlds.make_world import make_world, register_world
from .diagrams.worlds.world import World
from .systems.collision.esdf import Esdf
from .systems.collision.esdf_collision import EsdfCollision
from .systems.collision.field_mesh import field_mesh, write_mesh
from .systems.configuration import dump_config, load_config
from .systems.policies.hypothesis_selector import HypothesisSelector
from .systems.policies.privileged_planner import PrivilegedPlanner
from .systems.sensing.observation_noise import ObservationNoise
from .systems.sensing.onboard_camera import OnboardCamera
from .systems.splats.baked_scene import BakedScene
from .systems.splats.distortion import Distortion
from .systems.splats.gaussian_ply import read_ply, write_ply
from .systems.splats.gaussian_scene import GaussianScene
from .systems.splats.rasterization import rasterize
from .systems.splats.splat_camera import SplatCamera
from .systems.splats.splat_render_engine import SplatRenderEngine
from .systems.vehicle.flatness_controller import FlatnessController
from .systems.vehicle.quadrotor_dynamics import QuadrotorParams, hover_state
from .systems.vehicle.quadrotor_plant import QuadrotorPlant
from .systems.vehicle.quadrotor_state import QuadrotorState
from .systems.vehicle.state_to_pose import StateToPose
from .training.captures.capture import Capture
from .training.captures.capture_registry import read_capture, register_capture
from .training.policies.registry import register_trainer
from .training.reconstruction.reconstruct import reconstruct

__all__ = [
    "BakedScene",
    "BuildFlightDiagram",
    "Capture",
    "Distortion",
    "Esdf",
    "EsdfCollision",
    "FlatnessController",
    "Flight",
    "GaussianScene",
    "HypothesisSelector",
    "MakeCamera",
    "ObservationNoise",
    "OnboardCamera",
    "Outcome",
    "PrivilegedPlanner",
    "QuadrotorParams",
    "QuadrotorPlant",
    "QuadrotorState",
    "Scenario",
    "SplatCamera",
    "SplatRenderEngine",
    "StateToPose",
    "World",
    "__version__",
    "dump_config",
    "field_mesh",
    "fly",
    "hover_state",
    "load_config",
    "make_world",
    "policy_named",
    "random_flights",
    "rasterize",
    "read_capture",
    "read_ply",
    "reconstruct",
    "register_capture",
    "register_policy",
    "register_sensor",
    "register_trainer",
    "register_world",
    "sample_initial_state",
    "write_mesh",
    "write_ply",
]

__version__: str
