"""Controls of a running simulation, by a real browser."""

import gc
import threading
import time

import msgpack
import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from splatpilot.systems.collision.shapes import AnalyticDistanceField, Sphere
from splatpilot.systems.vehicle.quadrotor import hover_state
from splatpilot.systems.visualization.live import (
    PAUSE_BUTTON,
    RATE_SLIDER,
    RESTART,
    SLICE_SLIDER,
    LiveControls,
)
from splatpilot.systems.visualization.meshcat_drawing import draw_goal, draw_vehicle

FIELD = AnalyticDistanceField([Sphere([2, 0, 1], 0.5)], [0, -10, 0], [20, 10, 5])


class Drifter(LeafSystem):
    """A mass at (0, 0, 1) m that its disturbance accelerates."""

    def __init__(self, flying):
        super().__init__()
        self.flying = flying
        self.DeclareVectorInputPort("disturbance", 3)
        self.DeclareContinuousState(6)
        self.DeclareVectorOutputPort("state", 13, self._calc)

    def _calc(self, context, output):
        x = hover_state([0, 0, 1])
        x[:6] += context.get_continuous_state_vector().CopyToVector()
        output.SetFromVector(x)

    def DoCalcTimeDerivatives(self, context, derivatives):
        port = self.GetInputPort("disturbance")
        self.flying.pushed = np.array(port.Eval(context) if port.HasValue(context) else [0.0] * 3)
        v = context.get_continuous_state_vector().CopyToVector()[3:]
        derivatives.get_mutable_vector().SetFromVector(np.concatenate([v, self.flying.pushed]))


class Watched(LiveControls):
    """Controls that tell `flying` what they have set: Meshcat is for one thread alone."""

    def _apply(self, context):
        super()._apply(context)
        packed = msgpack.unpackb(self._meshcat._GetPackedTransform("/splatpilot/goal"))
        self.flying.seen = {
            "time": context.get_time(),
            "paused": self.paused,
            "goal": packed["matrix"][12:15],
            "rate": self._meshcat.GetSliderValue(RATE_SLIDER),
            "slice": self._meshcat.HasPath("/splatpilot/distance_slice"),
        }


class Flying:
    """A simulation with controls, which runs in a thread."""

    def __init__(self):
        self.ended, self.url = "", ""
        self.seen, self.pushed = {}, np.zeros(3)
        self.closed = threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        self._simulate()
        gc.collect()  # Meshcat must be freed by the thread that made it.

    def _simulate(self):
        meshcat = Meshcat()
        draw_vehicle(meshcat, "/splatpilot/vehicle", 0.35)
        draw_goal(meshcat, "/splatpilot/goal", np.array([0.0, 2.0, 1.0]), 0.3)
        meshcat.SetCameraPose([-6, 0, 1], [0, 0, 1])
        builder = DiagramBuilder()
        builder.AddNamedSystem("plant", Drifter(self))
        goal = builder.AddNamedSystem("goal", ConstantVectorSource([0.0, 2.0, 1.0]))
        diagram = builder.Build()
        simulator = Simulator(diagram)
        simulator.get_mutable_integrator().set_fixed_step_mode(True)
        simulator.get_mutable_integrator().set_maximum_step_size(0.02)
        controls = Watched(meshcat, diagram, FIELD)
        controls.flying = self
        simulator.set_monitor(controls)
        self.url = meshcat.web_url()
        self.ended = simulator.AdvanceTo(3600.0).message()
        context = goal.GetMyContextFromRoot(simulator.get_context())
        self.p_WG = np.array(goal.get_source_value(context).value())
        # Meshcat's server may log, in Python, as long as it has a viewer.
        self.closed.wait(20)


def until(condition, what: str, act=lambda: None) -> None:
    """Acts, and waits until a condition holds."""
    act()
    started = time.perf_counter()
    while not condition():
        assert time.perf_counter() - started < 20, what
        time.sleep(0.002)


@pytest.fixture
def flying(browser):
    flight = Flying()
    until(lambda: flight.url, "controls")
    time.sleep(0.1)
    assert not flight.seen  # It waits for a viewer.
    flight.tab = browser.new_page(viewport={"width": 600, "height": 400})
    flight.tab.goto(flight.url)
    until(lambda: flight.seen, "starts with the first viewer")
    flight.tab.wait_for_function(
        "viewer.scene_tree.find(['drake', 'illustration', 'plant', 'plant']).object.children.length"
    )
    flight.tab.get_by_text("Open Controls").click()
    yield flight
    if not flight.ended:
        flight.tab.keyboard.press("r")
    until(lambda: flight.ended, "end")
    flight.tab.close()
    flight.closed.set()
    flight.thread.join(20)


def set_slider(tab, name: str, value: float) -> None:
    row = tab.locator("li", has_text=name).locator("input").last
    row.fill(str(value))
    row.press("Enter")
    row.blur()


def drag(tab, x: int, y: int, dx: int) -> None:
    tab.keyboard.down("Control")
    tab.mouse.move(x, y)
    tab.mouse.down()
    tab.keyboard.up("Control")
    tab.mouse.move(x + dx, y)


def test_simulation_pauses_steps_changes_its_rate_draws_the_slice_and_restarts(flying):
    keyboard, seen = flying.tab.keyboard, lambda name: flying.seen[name]
    until(lambda: seen("paused"), "pause", lambda: keyboard.press("Space"))
    before = seen("time")
    time.sleep(0.1)
    assert seen("time") == before
    # A step is over in 0.1 s, which a loaded machine may not see; its effect stays.
    until(lambda: seen("paused") and seen("time") > before, "step", lambda: keyboard.press("n"))
    assert seen("time") == pytest.approx(before + 0.1)
    resume = flying.tab.get_by_text(PAUSE_BUTTON)
    until(lambda: not seen("paused"), "resume", resume.click)
    until(lambda: seen("rate") == 0.25, "rate", lambda: set_slider(flying.tab, RATE_SLIDER, 0.25))
    wall, flown = time.perf_counter(), seen("time")
    until(lambda: seen("time") > flown + 0.2, "flight at a quarter of the rate")
    assert time.perf_counter() - wall > 0.6  # A loaded machine may be slower, never faster.
    until(lambda: seen("slice"), "slice", lambda: set_slider(flying.tab, SLICE_SLIDER, 1.5))
    until(lambda: flying.ended, "restart", lambda: keyboard.press("r"))
    assert flying.ended == RESTART


def test_mouse_drags_the_goal_and_pushes_the_vehicle(flying):
    x, y = flying.tab.evaluate(
        """() => {
          const q = new MeshCat.THREE.Vector3(0, 2, 1);
          viewer.scene.localToWorld(q).project(viewer.camera);
          return [(0.5 + 0.5 * q.x) * innerWidth, (0.5 - 0.5 * q.y) * innerHeight];
        }"""
    )

    def goal():
        return np.array(flying.seen["goal"])

    until(lambda: goal()[1] < 1.8, "goal", lambda: drag(flying.tab, x, y, 40))
    flying.tab.mouse.up()
    np.testing.assert_allclose(goal()[[0, 2]], [0, 1], atol=0.05)
    until(lambda: flying.pushed[1] > 1, "push", lambda: drag(flying.tab, 300, 200, -50))
    until(lambda: not flying.pushed.any(), "end of the push", flying.tab.mouse.up)
    flying.tab.keyboard.press("r")
    until(lambda: flying.ended, "restart")
    np.testing.assert_allclose(flying.p_WG, goal())
