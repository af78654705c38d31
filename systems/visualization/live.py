"""LiveControls: the viewers of Meshcat pause, step, restart and push a running simulation."""

import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat, Sphere
from pydrake.lcm import DrakeLcm
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.common.drake import add_slider, vector_output
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.systems.vehicle.state import QuadrotorState
from splatpilot.systems.visualization.meshcat_drawing import draw_distance_slice, vehicle_path

RESTART = "restart"
"""Message of the termination that the button for it causes."""

PAUSE_BUTTON, STEP_BUTTON, RESTART_BUTTON = "pause or resume (space)", "step (n)", "restart (r)"
RATE_SLIDER, SLICE_SLIDER = "real-time rate", "distances at [m]"
STEP_TIME = 0.1  # [s] of simulated time
STIFFNESS = 25.0  # [1/s^2] of the spring between a dragged vehicle and the mouse
_PUSH = "disturbance"  # [m/s^2] port of vehicles
_POLL = 0.01  # [s] between looks at the controls while the simulation waits
_HANDLE_RADIUS = 0.5  # [m] of goals
_MAX_DELAY = 0.2  # [s] behind real time that are caught up


class DragHandles:
    """Invisible spheres in Meshcat that the mouse drags with the Ctrl key, by Drake's springs."""

    def __init__(self, meshcat: Meshcat, radii: Mapping[str, float]):
        """Adds a sphere of each radius [m], by name."""
        # These are slow to load.
        from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
        from pydrake.multibody.tree import SpatialInertia
        from pydrake.visualization import ApplyVisualizationConfig, VisualizationConfig

        builder = DiagramBuilder()
        self._plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        for name, radius in radii.items():
            body = self._plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, radius))
            clear = np.array([1.0, 1.0, 1.0, 0.0])
            self._plant.RegisterVisualGeometry(body, RigidTransform(), Sphere(radius), name, clear)
        self._plant.Finalize()
        config = VisualizationConfig(
            publish_contacts=False,
            publish_proximity=False,
            publish_inertia=False,
            mouse_interaction_stiffness=STIFFNESS,
        )
        self._lcm = DrakeLcm("memq://")  # Drake does not keep it alive.
        ApplyVisualizationConfig(
            config, builder, None, self._plant, scene_graph, meshcat=meshcat, lcm=self._lcm
        )
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)

    def move(self, name: str, p_WQ: ArrayLike, v_WQ: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Moves a sphere to a position [m] with a velocity [m/s]."""
        from pydrake.multibody.math import SpatialVelocity

        body, context = self._plant.GetBodyByName(name), self._plant_context
        self._plant.SetFreeBodyPose(context, body, RigidTransform(np.asarray(p_WQ)))
        velocity = SpatialVelocity(np.zeros(3), np.asarray(v_WQ, dtype=float))
        self._plant.SetFreeBodySpatialVelocity(context, body, velocity)

    def draw(self) -> None:
        """Shows the spheres where they are now."""
        self._diagram.ForcedPublish(self._context)

    def dragged(self) -> tuple[str, np.ndarray, np.ndarray] | None:
        """Returns the name of the dragged sphere, its grabbed point p_WQ (3,) [m], and the
        acceleration (3,) [m/s^2] of the spring; None if no sphere is dragged."""
        port = self._plant.get_applied_spatial_force_input_port()
        for force in port.Eval(self._plant_context):
            body = self._plant.get_body(force.body_index)
            X_WQ = body.EvalPoseInWorld(self._plant_context)
            return body.name(), X_WQ @ force.p_BoBq_B, force.F_Bq_W.translational()
        return None


class LiveControls:
    """Lets the viewers of Meshcat control a simulation; a monitor of `fly` or a Drake Simulator.

    - Buttons pause, step and restart: the last ends the simulation with the message `RESTART`.
    - A slider sets the real-time rate, 0 for as fast as possible, another the height of the slice
      of the distance field, which the lowest one hides.
    - With the Ctrl key the mouse drags each goal (a ConstantVectorSource named `goal` or
      `NAME_goal`), and by a spring each system with the ports of `QuadrotorPlant`.

    The simulation starts when the first viewer is connected.
    """

    def __init__(self, meshcat: Meshcat, diagram: Diagram, field: DistanceField | None = None):
        """Adds the controls to Meshcat.

        Args:
            diagram: the simulated one, that holds goals and vehicles.
            field: distance field, for the slice.
        """
        self._meshcat, self._diagram, self._field = meshcat, diagram, field
        systems = {system.get_name(): system for system in diagram.GetSystems()}
        self._goals = {
            name: system
            for name, system in systems.items()
            if isinstance(system, ConstantVectorSource) and f"_{name}".endswith("_goal")
        }
        self._vehicles = {
            name: system
            for name, system in systems.items()
            if system.HasInputPort(_PUSH) and system.HasOutputPort("state")
        }
        radii = dict.fromkeys(self._goals, _HANDLE_RADIUS)
        self._handles = DragHandles(meshcat, radii | dict.fromkeys(self._vehicles, VEHICLE_RADIUS))
        self._grabbed: tuple[str, np.ndarray] | None = None
        keys = {PAUSE_BUTTON: "Space", STEP_BUTTON: "KeyN", RESTART_BUTTON: "KeyR"}
        for name, key in keys.items():
            meshcat.AddButton(name, key)
        self._clicks = dict.fromkeys(keys, 0)
        add_slider(meshcat, RATE_SLIDER, (0.0, 4.0), 0.25, 1.0)
        self._rate = 1.0
        if field is not None:
            lower, upper = float(field.lower_W[2]), float(field.upper_W[2])
            add_slider(meshcat, SLICE_SLIDER, (lower, upper), (upper - lower) / 50, lower)
            self._height = meshcat.GetSliderValue(SLICE_SLIDER)
        self.paused = False
        self._pause_time = np.inf  # [s] simulated, of the end of a step
        self._last_time = np.inf
        self._reset_clock(0.0)

    def __call__(self, context: Context) -> EventStatus:
        """Waits as long as the viewers want; see `Simulator.set_monitor`."""
        now = context.get_time()
        if now < self._last_time:  # the start
            self.wait_for_viewer()
            self._pause_time = np.inf
            self._reset_clock(now)
        self._last_time = now
        if now >= self._pause_time - 1e-9:
            self.paused, self._pause_time = True, np.inf
        while True:
            self._apply(context)
            if self._clicked(RESTART_BUTTON):
                return EventStatus.ReachedTermination(self._diagram, RESTART)
            if not self.paused and self._lead(now) <= 0:
                return EventStatus.DidNothing()
            time.sleep(_POLL)

    def wait_for_viewer(self) -> None:
        """Waits until the page of Meshcat, or one that shows it, is open."""
        while not self._meshcat.GetNumActiveConnections():
            time.sleep(_POLL)

    def wait_for_restart(self, stop: Callable[[], bool]) -> bool:
        """Waits for a click on the button to restart; returns False if `stop` returns True."""
        while not self._clicked(RESTART_BUTTON):
            if stop():
                return False
            time.sleep(_POLL)
        return True

    def _reset_clock(self, now: float) -> None:
        self._wall_start, self._sim_start = time.perf_counter(), now

    def _lead(self, now: float) -> float:
        """Returns the time [s] by which the simulation is ahead of the rate."""
        if self._rate == 0:
            return 0.0
        flown = (now - self._sim_start) / self._rate
        lead = flown - (time.perf_counter() - self._wall_start)
        if lead < -_MAX_DELAY:
            self._reset_clock(now)
        return lead

    def _clicked(self, button: str) -> bool:
        clicks = self._meshcat.GetButtonClicks(button)
        before, self._clicks[button] = self._clicks[button], clicks
        return clicks > before

    def _apply(self, context: Context) -> None:
        """Applies the controls to the simulation at its present time."""
        now = context.get_time()
        if self._clicked(PAUSE_BUTTON):
            self.paused = not self.paused
            self._reset_clock(now)
        if self._clicked(STEP_BUTTON):
            self.paused, self._pause_time = False, now + STEP_TIME
            self._reset_clock(now)
        rate = self._meshcat.GetSliderValue(RATE_SLIDER)
        if rate != self._rate:
            self._rate = rate
            self._reset_clock(now)
        if self._field is not None:
            self._draw_slice(self._field)
        self._drag(context)

    def _draw_slice(self, field: DistanceField) -> None:
        height, path = self._meshcat.GetSliderValue(SLICE_SLIDER), "/splatpilot/distance_slice"
        if height == self._height:
            return
        shown = height > field.lower_W[2]
        if shown:
            draw_distance_slice(self._meshcat, path, field, height)
        self._meshcat.SetProperty(path, "visible", bool(shown))
        self._height = height

    def _drag(self, context: Context) -> None:
        """Moves the goals, and pushes the vehicles."""
        for name, goal in self._goals.items():
            p_WG = goal.get_source_value(goal.GetMyContextFromRoot(context)).value()
            self._handles.move(name, p_WG)
            path = f"{vehicle_path(goal, 'goal')}/goal"
            self._meshcat.SetTransform(path, RigidTransform(p_WG))
        for name, vehicle in self._vehicles.items():
            x = vector_output(vehicle, "state", vehicle.GetMyContextFromRoot(context))
            state = QuadrotorState.of(x)
            self._handles.move(name, state.p_WB, state.v_WB)
        self._handles.draw()
        before, dragged = self._grabbed, self._handles.dragged()
        if before is not None and before[0] in self._vehicles and dragged is None:
            self._push(before[0], np.zeros(3), context)
        self._grabbed = None
        if dragged is None:
            return
        name, p_WQ, acceleration = dragged
        if name in self._vehicles:
            self._push(name, acceleration, context)
            self._grabbed = name, p_WQ
            return
        goal = self._goals[name]
        value = goal.get_mutable_source_value(goal.GetMyMutableContextFromRoot(context))
        # The viewer's report may be of an earlier goal: the grabbed point is that of the start.
        grip = p_WQ - value.value() if before is None or before[0] != name else before[1]
        self._grabbed = name, grip
        value.set_value(p_WQ + acceleration / STIFFNESS - grip)

    def _push(self, name: str, acceleration: np.ndarray, context: Context) -> None:
        vehicle = self._vehicles[name]
        port = vehicle.GetInputPort(_PUSH)
        port.FixValue(vehicle.GetMyMutableContextFromRoot(context), acceleration)
