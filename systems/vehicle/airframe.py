"""The quadrotor as a rigid body of Drake's `MultibodyPlant` with four propellers."""

from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialAcceleration, SpatialForce
from pydrake.multibody.plant import (
    ExternallyAppliedSpatialForce,
    ExternallyAppliedSpatialForceMultiplexer,
    MultibodyPlant,
    Propeller,
    PropellerInfo,
)
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.framework import (
    BasicVector,
    Context,
    ContinuousState,
    Diagram,
    DiagramBuilder,
    LeafSystem,
)

from splatpilot.systems.common.drake import optional_input, vector_input, weak_callback
from splatpilot.systems.common.validation import require, require_type
from splatpilot.systems.vehicle.quadrotor import (
    QuadrotorParams,
    actuated_derivatives,
    hover_state,
    hovering_actuators,
    lift_factor,
    limit_command,
)
from splatpilot.systems.vehicle.state import QuadrotorState, pose_from_state, rotation_matrices

_FORCES: Any = Value[list[ExternallyAppliedSpatialForce]]
_ACCELERATIONS: Any = Value[list[SpatialAcceleration]]


class QuadrotorAirframe(Diagram):
    """Simulates a quadrotor with `model: rotors` as a body with propellers.

    .. pydrake_system::

        name: QuadrotorAirframe
        input_ports: [command, wind, disturbance]
        output_ports: [state, acceleration]

    The ports are those of `QuadrotorPlant`. Motion follows from Drake's equations of rigid bodies
    and from the forces of its `Propeller`; motors, mixer, rate controller, drag and battery are
    those of `actuated_derivatives`. Supports the scalar float.
    """

    def __init__(
        self, params: QuadrotorParams | None = None, initial_state: np.ndarray | None = None
    ) -> None:
        super().__init__()
        params = QuadrotorParams() if params is None else params
        require_type(params, QuadrotorParams, "params")
        params.validate()
        require(params.model == "rotors", "params.model", "rotors", params.model)
        start = hover_state([0.0, 0.0, 0.0]) if initial_state is None else initial_state
        at_rest = not QuadrotorState.of(start).v_WB.any() and not start[10:].any()
        require(at_rest, "initial_state", "at rest", start.tolist())

        # Rigid body and propellers. Their command is a force [N].
        builder = DiagramBuilder()
        plant: Any = builder.AddNamedSystem("plant", MultibodyPlant(time_step=0.0))
        unit = UnitInertia(*(J / params.mass for J in params.inertia))
        body = plant.AddRigidBody("airframe", SpatialInertia(params.mass, np.zeros(3), unit))
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -params.gravity])
        plant.Finalize()
        plant.SetDefaultFloatingBaseBodyPose(body, pose_from_state(start))
        (x, y), turn = params.arm, params.torque_ratio
        rotors = ((x, y, turn), (-x, y, -turn), (-x, -y, turn), (x, -y, -turn))  # as `mix`
        propellers = [
            PropellerInfo(body.index(), RigidTransform(np.array([px, py, 0.0])), 1.0, moment)
            for px, py, moment in rotors
        ]
        propeller: Any = builder.AddNamedSystem("propellers", Propeller(propellers))
        builder.Connect(plant.get_body_poses_output_port(), propeller.get_body_poses_input_port())

        # Rotors, drag and state.
        motion = builder.AddNamedSystem("motion", _Motion(int(body.index())))
        builder.Connect(plant.get_state_output_port(), motion.GetInputPort("plant_state"))
        builder.Connect(
            plant.get_body_spatial_accelerations_output_port(),
            motion.GetInputPort("accelerations"),
        )
        rotor = builder.AddNamedSystem("rotors", _Rotors(params, body.index()))
        builder.Connect(motion.GetOutputPort("state"), rotor.GetInputPort("state"))
        builder.Connect(rotor.GetOutputPort("thrusts"), propeller.get_command_input_port())
        forces = builder.AddSystem(ExternallyAppliedSpatialForceMultiplexer(2))
        builder.Connect(propeller.get_spatial_forces_output_port(), forces.get_input_port(0))
        builder.Connect(rotor.GetOutputPort("air"), forces.get_input_port(1))
        builder.Connect(forces.get_output_port(), plant.get_applied_spatial_force_input_port())
        for name in ("command", "wind", "disturbance"):
            builder.ExportInput(rotor.GetInputPort(name), name)
        for name in ("state", "acceleration"):
            builder.ExportOutput(motion.GetOutputPort(name), name)
        builder.BuildInto(self)


class _Rotors(LeafSystem):
    """Computes the thrusts of the rotors, and the force of the air on the body.

    Continuous state: charge and rotor speeds, see `actuated_derivatives`.
    """

    def __init__(self, params: QuadrotorParams, body: Any) -> None:
        super().__init__()
        self._params, self._body = params, body
        for name, size in (("state", 13), ("command", 4), ("wind", 3), ("disturbance", 3)):
            self.DeclareVectorInputPort(name, size)
        self.DeclareContinuousState(BasicVector(np.array(hovering_actuators(params))))
        state = self.GetInputPort("state").ticket()
        self.DeclareVectorOutputPort("thrusts", 4, self._calc_thrusts, {self.xc_ticket(), state})
        calc = weak_callback(self._calc_air)
        self.DeclareAbstractOutputPort("air", lambda: _FORCES(), calc)

    def _actuators(self, context: Context) -> list[float]:
        return context.get_continuous_state_vector().CopyToVector().tolist()

    def _thrusts(self, context: Context) -> list[float]:
        charge, *speeds = self._actuators(context)
        z = vector_input(self, "state", context)[2]
        lift = lift_factor(z, charge, self._params)
        return [lift * self._params.thrust_coefficient * u * u for u in speeds]

    def _rates(self, context: Context) -> list[Any]:
        state = vector_input(self, "state", context).tolist() + self._actuators(context)
        command = limit_command(vector_input(self, "command", context), self._params)
        others = (optional_input(self, name, context) for name in ("wind", "disturbance"))
        return actuated_derivatives(state, command, self._params, *others)

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        derivatives.get_mutable_vector().SetFromVector(np.array(self._rates(context)[13:]))

    def _calc_thrusts(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(np.array(self._thrusts(context)))

    def _calc_air(self, context: Context, output: AbstractValue) -> None:
        R_WB = rotation_matrices(vector_input(self, "state", context)[6:10])
        weight = [0.0, 0.0, self._params.gravity]
        force = self._params.mass * np.add(self._rates(context)[3:6], weight)
        applied = ExternallyAppliedSpatialForce()
        applied.body_index, applied.p_BoBq_B = self._body, np.zeros(3)
        air = force - sum(self._thrusts(context)) * R_WB[:, 2]
        applied.F_Bq_W = SpatialForce(np.zeros(3), air)
        output.set_value([applied])


class _Motion(LeafSystem):
    """Outputs state and acceleration of a body as `QuadrotorPlant` does."""

    def __init__(self, body: int) -> None:
        super().__init__()
        self._body = body
        plant_state = self.DeclareVectorInputPort("plant_state", 13)
        accelerations = self.DeclareAbstractInputPort("accelerations", _ACCELERATIONS())
        self.DeclareVectorOutputPort("state", 13, self._calc_state, {plant_state.ticket()})
        self.DeclareVectorOutputPort(
            "acceleration", 3, self._calc_acceleration, {accelerations.ticket()}
        )

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        q_WB, p_WB, w_WB, v_WB = np.split(vector_input(self, "plant_state", context), [4, 7, 10])
        w_WB_B = rotation_matrices(q_WB).T @ w_WB
        output.SetFromVector(QuadrotorState(p_WB, v_WB, q_WB, w_WB_B).to_vector())

    def _calc_acceleration(self, context: Context, output: BasicVector) -> None:
        accelerations: Any = self.GetInputPort("accelerations").Eval(context)
        output.SetFromVector(accelerations[self._body].translational())
