"""GymPolicy: flies by a function that was trained in the environments."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem, State

from splatpilot.diagrams.flight.blocks import DECISIONS
from splatpilot.diagrams.gym.spaces import (
    IMAGES,
    FlightEnvConfig,
    Vehicles,
    decisions,
    observation_space,
    observe,
    observe_image,
    require_actions,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.drake import optional_input, vector_input
from splatpilot.systems.common.validation import require
from splatpilot.systems.policies.base import CHANNELS


class GymPolicy(LeafSystem):
    """Decides by a function from observations to actions, as it was trained in `FlightEnv`.

        model = PPO.load("out/ppo")
        config = sp.FlightEnvConfig(observation=["depth", "state", "goal"])
        policy = sp.GymPolicy(lambda seen: model.predict(seen, deterministic=True)[0], config)

    .. pydrake_system::

        name: GymPolicy
        input_ports: [state, goal, (images), moving (with obstacle)]
        output_ports: [(action)]

    The inputs are ``state`` (13), ``goal`` (3), p_WG [m], and the observed images. The output has
    the name and size of `config.action`, see `AddFlight`. It is decided from time 0 at
    `config.rate`, and held. Flights equal those of `FlightEnv` with the same actions.

    Args:
        predict: from the observation of one vehicle to its action (n,) in [-1, 1].
        config: of the environment of the training; of its scenario, gravity counts alone.
        world: of the flight, for the observation `obstacle`.
    """

    def __init__(
        self,
        predict: Callable[[Any], NDArray[Any]],
        config: FlightEnvConfig,
        world: World | None = None,
    ) -> None:
        super().__init__()
        config.validate()
        observation_space(config)  # checks the names
        self._predict, self._config, self._names = predict, config, config.observation_names()
        valid = world is not None or "obstacle" not in self._names
        require(valid, "world", "that of the flight for the observation obstacle", "None")
        self._field = world.distance_field if world and "obstacle" in self._names else None
        self.camera, self.rate = config.camera, config.rate
        self._size = DECISIONS[config.action]
        self.DeclareVectorInputPort("state", 13)
        self.DeclareVectorInputPort("goal", 3)
        if self._field is not None:
            self.DeclareAbstractInputPort("moving", AbstractValue.Make(object()))
        size = config.camera.width, config.camera.height
        for port in dict.fromkeys(IMAGES[name] for name in self._names if name in IMAGES):
            self.DeclareAbstractInputPort(port, Value(cast(Any, CHANNELS[port][0])(*size)))
        self.DeclareStateOutputPort(config.action, self.DeclareDiscreteState(self._size))
        # Actions precede the controller's update of the same time, as unrestricted updates do; and
        # its times are whole numbers of its period, in which sums of other periods are not.
        period = config.scenario.controller.period
        self._every = round(1.0 / (config.rate * period))
        self._turn = int(self.DeclareDiscreteState(1))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._update)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._begin)

    def _begin(self, context: Context, state: State) -> None:
        """Hovers until the first decision has come, as the environment does."""
        states, hover = vector_input(self, "state", context)[None], np.zeros((1, self._size))
        state.get_mutable_discrete_state(0).set_value(decisions(self._config, hover, states)[0])

    def _update(self, context: Context, state: State) -> None:
        turn = context.get_discrete_state(self._turn).GetAtIndex(0)
        state.get_mutable_discrete_state(self._turn).SetAtIndex(0, (turn + 1) % self._every)
        if turn:
            return
        config = self._config
        states, p_WG = (vector_input(self, name, context)[None] for name in ("state", "goal"))
        vehicles = Vehicles(states, p_WG, np.full(1, np.nan), np.zeros((1, 3)))
        if (field := self._field) is not None:
            if bodies := optional_input(self, "moving", context):
                field = bodies.among(field, bodies.time)
            sample = field.query(states[:, :3])
            vehicles = Vehicles(states, p_WG, sample.distance, sample.gradient)
        seen: dict[str, Any] = {n: v[0] for n, v in observe(self._names, vehicles).items()}
        for name in self._names:
            if name in IMAGES:
                image: Any = self.GetInputPort(IMAGES[name]).Eval(context)
                pixels = np.array(image.data[..., CHANNELS[IMAGES[name]][1]])
                seen[name] = observe_image(name, pixels, config.camera.max_depth)
        action = self._predict(config.arrange(seen))
        decision = decisions(config, require_actions(action, (self._size,))[None], states)
        state.get_mutable_discrete_state(0).set_value(decision[0])
