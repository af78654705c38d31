from .analysis.benchmark.run_study import study
from .diagrams.flight.blocks import MakeCamera
from .diagrams.flight.flight_diagram import (
    AddFlight,
    AddMeshcat,
    AddMovingBody,
    AddSplatWorld,
    BuildFlightDiagram,
    ExportFlight,
    FlightParts,
    open_meshcat,
)
from .diagrams.flight.fly import flight_page
from .diagrams.flight.monitor import AddFlightMonitor, FlightMonitor, Outcome
from .diagrams.flight.policies import policy_named, register_policy
from .diagrams.flight.scenario import Scenario, sample_initial_state, sample_scenario
from .diagrams.flight.sensors import register_sensor
from .diagrams.flight.simulation import (
    Flight,
    FlightError,
    fly,
    fly_all,
    make_flight_simulator,
    random_flights,
)
from .diagrams.gym.flight_env import FlightEnv
from .diagrams.gym.gym_policy import GymPolicy
from .diagrams.gym.spaces import FlightEnvConfig, Reward, Transition, find_scenario
from .diagrams.gym.vector_env import VectorFlightEnv
from .diagrams.worlds.file_worlds import MeshWorld, OctomapConfig
from .diagrams.worlds.forest.layout import ForestConfig
from .diagrams.worlds.indoor import OfficeConfig, RoomConfig
from .diagrams.worlds.moving_spheres import MovingSphere
from .diagrams.worlds.outdoor import BranchesConfig, ClutterConfig, OverUnderConfig, WallsConfig
from .diagrams.worlds.scene_folder import SceneConfig
from .diagrams.worlds.world import World
from .diagrams.worlds.world_registry import make_world, register_world
from .systems.collision.distance_field import FieldState
from .systems.collision.esdf import Esdf
from .systems.collision.esdf_collision import (
    AddBarrierCost,
    AddClearanceConstraint,
    EsdfCollision,
    EsdfCollision_,
)
from .systems.collision.field_mesh import field_mesh, write_mesh
from .systems.common.config import dump_config, load_config
from .systems.common.provenance import InfeasibleFlightError
from .systems.common.validation import Config, bounded
from .systems.policies.hypotheses import Hypotheses, HypothesisSelector, HypothesisSelector_
from .systems.policies.planner import PrivilegedPlanner
from .systems.policies.velocity import VelocityTracker, VelocityTracker_
from .systems.sensing.imu import Imu, RangeFinder
from .systems.sensing.noise import ObservationNoise
from .systems.sensing.onboard_camera import OnboardCamera
from .systems.splats.baked_scene import BakedScene
from .systems.splats.lens import Distortion
from .systems.splats.moving_bodies import MovingBodies
from .systems.splats.rasterization import rasterize
from .systems.splats.render_engine import SplatRenderEngine, gaussian_properties
from .systems.splats.scene import GaussianScene
from .systems.splats.splat_camera import SplatCamera
from .systems.splats.splat_files import read_ply, write_ply
from .systems.vehicle.airframe import QuadrotorAirframe
from .systems.vehicle.flatness import FlatnessController, FlatnessController_
from .systems.vehicle.quadrotor import (
    QuadrotorParams,
    QuadrotorPlant,
    QuadrotorPlant_,
    hover_state,
)
from .systems.vehicle.quadrotor_geometry import QuadrotorGeometry, quadrotor_gaussians
from .systems.vehicle.state import QuadrotorState, StateToPose, StateToPose_
from .systems.vehicle.vehicles import (
    Crazyflie21Brushless,
    Kingfisher,
    Px4Sih,
    Starling2Max,
    register_vehicle,
)
from .systems.vehicle.wind import DrydenWind, DrydenWind_, Wind
from .systems.visualization.flight_visualizer import FlightVisualizer
from .systems.visualization.live import LiveControls
from .systems.visualization.meshcat_drawing import CameraVisualizer
from .systems.visualization.rerun_sink import RerunSink
from .systems.visualization.video import VideoRecorder
from .training.captures.capture import Capture
from .training.captures.capture_config import CaptureConfig
from .training.captures.capture_registry import read_capture, register_capture
from .training.corpus.corpus import Corpus
from .training.policies.train import register_trainer
from .training.reconstruction.config import ReconstructConfig
from .training.reconstruction.reconstruct import reconstruct

__all__ = [
    "AddBarrierCost",
    "AddClearanceConstraint",
    "AddFlight",
    "AddFlightMonitor",
    "AddMeshcat",
    "AddMovingBody",
    "AddSplatWorld",
    "BakedScene",
    "BranchesConfig",
    "BuildFlightDiagram",
    "CameraVisualizer",
    "Capture",
    "CaptureConfig",
    "ClutterConfig",
    "Config",
    "Corpus",
    "Crazyflie21Brushless",
    "Distortion",
    "DrydenWind",
    "DrydenWind_",
    "Esdf",
    "EsdfCollision",
    "EsdfCollision_",
    "ExportFlight",
    "FieldState",
    "FlatnessController",
    "FlatnessController_",
    "Flight",
    "FlightEnv",
    "FlightEnvConfig",
    "FlightError",
    "FlightMonitor",
    "FlightParts",
    "FlightVisualizer",
    "ForestConfig",
    "GaussianScene",
    "GymPolicy",
    "Hypotheses",
    "HypothesisSelector",
    "HypothesisSelector_",
    "Imu",
    "InfeasibleFlightError",
    "Kingfisher",
    "LiveControls",
    "MakeCamera",
    "MeshWorld",
    "MovingBodies",
    "MovingSphere",
    "ObservationNoise",
    "OctomapConfig",
    "OfficeConfig",
    "OnboardCamera",
    "Outcome",
    "OverUnderConfig",
    "PrivilegedPlanner",
    "Px4Sih",
    "QuadrotorAirframe",
    "QuadrotorGeometry",
    "QuadrotorParams",
    "QuadrotorPlant",
    "QuadrotorPlant_",
    "QuadrotorState",
    "RangeFinder",
    "ReconstructConfig",
    "RerunSink",
    "Reward",
    "RoomConfig",
    "Scenario",
    "SceneConfig",
    "SplatCamera",
    "SplatRenderEngine",
    "Starling2Max",
    "StateToPose",
    "StateToPose_",
    "Transition",
    "VectorFlightEnv",
    "VelocityTracker",
    "VelocityTracker_",
    "VideoRecorder",
    "WallsConfig",
    "Wind",
    "World",
    "__version__",
    "bounded",
    "dump_config",
    "field_mesh",
    "find_scenario",
    "flight_page",
    "fly",
    "fly_all",
    "gaussian_properties",
    "hover_state",
    "load_config",
    "make_flight_simulator",
    "make_world",
    "open_meshcat",
    "policy_named",
    "quadrotor_gaussians",
    "random_flights",
    "rasterize",
    "read_capture",
    "read_ply",
    "reconstruct",
    "register_capture",
    "register_policy",
    "register_sensor",
    "register_trainer",
    "register_vehicle",
    "register_world",
    "sample_initial_state",
    "sample_scenario",
    "study",
    "write_mesh",
    "write_ply",
]

__version__: str
