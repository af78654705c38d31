"""Student: three trajectories from one image of colours or depth, imitated."""

from dataclasses import dataclass, field
from typing import Any, ClassVar, cast

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from splatpilot.systems.policies.depth_policy_config import require_speed
from splatpilot.systems.policies.hypotheses import no_plan
from splatpilot.systems.policies.mirrored_views import plan_both_views
from splatpilot.systems.policies.policy_checkpoint import shipped_weights
from splatpilot.systems.policies.student_inference import RATE, load_network, plan
from splatpilot.systems.policies.student_spec import HYPOTHESES
from splatpilot.systems.ports import input_port, output_port
from splatpilot.systems.sensing.onboard_camera import OnboardCamera
from splatpilot.systems.vehicle.quadrotor_state import QuadrotorState
from splatpilot.systems.vehicle.state_to_pose import pose_from_state


@dataclass
class StudentConfig:
    """The student's weights, what it is asked for, and the camera that it sees through."""

    observation: ClassVar[str]
    """What it sees: rgb or depth."""
    shipped: ClassVar[str]
    """The name of its weights that ship."""
    mirrored: ClassVar[bool] = False
    """Whether it sees each image in a mirror too, and flies what both views agree upon, which at
    the goal is the unobstructed way."""
    rate: ClassVar[float] = RATE

    # [m/s] Speed that it is asked to fly at; the model card of its weights says its expert's.
    speed: float = 2.0
    # File of weights, as `splatpilot train` writes them; those that ship where left empty.
    weights: str = ""
    # With the size and field of view that it was trained with.
    camera: OnboardCamera = field(default_factory=lambda: OnboardCamera(width=160, height=120))

    def validate(self) -> None:
        """Raises ValueError on a value out of range, naming it, its limit and the remedy."""
        require_speed(self)
        self.camera.validate()


@dataclass
class StudentRgbConfig(StudentConfig):
    """A student that sees colours."""

    observation = "rgb"
    shipped = "student_rgb"


@dataclass
class PilotRgbConfig(StudentRgbConfig):
    """A student that sees colours twice, as they are and in a mirror. Any weights of `student_rgb`
    fit it; those that ship are its own."""

    shipped = "pilot_rgb"
    mirrored = True


@dataclass
class StudentDepthConfig(StudentConfig):
    """A student that sees depth."""

    observation = "depth"
    shipped = "student_depth"


class Student(LeafSystem):
    """Plans three trajectories with costs from an image of colours or of depth.

    .. pydrake_system::

        name: Student
        input_ports:
        - state
        - goal
        - color_image or depth_image_32f
        output_ports:
        - hypotheses

    - ``state`` (13): ``[p_WB (3) [m], v_WB (3) [m/s], q_WB (4, wxyz), w_WB_B (3) [rad/s]]``.
    - ``goal`` (3): p_WG [m], W frame.
    - ``color_image`` (RGBA) or ``depth_image_32f`` (planar [m]) of the camera ``config.camera``, by
      ``config.observation``.
    - ``hypotheses`` (8 + 31 * 3): as `Hypotheses.to_vector`, in the body frame B at the time of
      planning; a discrete state, NaN before the first update. Six of them, (8 + 31 * 6), of a
      config that is ``mirrored``.

    Updates at 15 Hz from time 0 by
    :func:`~splatpilot.systems.policies.student_inference.plan`, or, ``mirrored``, by
    :func:`~splatpilot.systems.policies.mirrored_views.plan_both_views`.

    Raises:
        ValueError, FileNotFoundError: from the constructor on a config out of range, on weights
            that are missing, damaged, or of another policy, version or architecture, and for a
            camera other than these were trained with.
    """

    state_input_port = input_port("state")
    goal_input_port = input_port("goal")
    hypotheses_output_port = output_port("hypotheses")

    def __init__(self, config: StudentConfig) -> None:
        super().__init__()
        config.validate()
        weights = config.weights or str(shipped_weights(config.shipped))
        self._network = load_network(weights, config.observation, config.speed)
        spec, camera = self._network.spec, config.camera
        for name in ("width", "height", "fov_x"):
            given, trained = getattr(camera, name), getattr(spec, name)
            if given != trained:
                raise ValueError(
                    f"camera.{name} of the student is {given}, but its weights were trained with "
                    f"{trained}; set it to that, or give weights that were trained with {given}"
                )
        self._state_port = self.DeclareVectorInputPort("state", 13)
        self._goal_port = self.DeclareVectorInputPort("goal", 3)
        name, image = {
            "rgb": ("color_image", ImageRgba8U),
            "depth": ("depth_image_32f", ImageDepth32F),
        }[config.observation]
        self._image_port = self.DeclareAbstractInputPort(
            name, Value(image(camera.width, camera.height))
        )
        self._plan = plan_both_views if config.mirrored else plan
        plans = no_plan(2 * HYPOTHESES if config.mirrored else HYPOTHESES)
        self.DeclareStateOutputPort("hypotheses", self.DeclareDiscreteState(plans))
        self.DeclarePeriodicDiscreteUpdateEvent(1.0 / config.rate, 0.0, self._update)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = np.asarray(self._state_port.Eval(context))
        pixels = np.asarray(cast(Any, self._image_port.Eval(context)).data)  # (H, W, 4 or 1)
        image = pixels[..., :3] if self._network.spec.observation == "rgb" else pixels[..., 0]
        hypotheses = self._plan(
            self._network,
            context.get_time(),
            image,
            pose_from_state(state),
            QuadrotorState.of(state).v_WB,
            np.asarray(self._goal_port.Eval(context)),
        )
        discrete_state.set_value(hypotheses.to_vector())
