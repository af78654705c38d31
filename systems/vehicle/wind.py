"""Wind: a constant mean, and Dryden gusts."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common.schema import GaussianVectorX
from pydrake.symbolic import Expression
from pydrake.systems.framework import (
    BasicVector_,  # pyright: ignore[reportAttributeAccessIssue]
    LeafSystem_,  # pyright: ignore[reportAttributeAccessIssue]
)
from scipy.linalg import block_diag, cholesky, expm, solve_continuous_lyapunov

from splatpilot.systems.common.distributions import draw
from splatpilot.systems.common.drake import (
    ConfigParameter,
    float_values,
    parameter_setter,
    system_template,
)
from splatpilot.systems.common.validation import (
    Config,
    bounded,
    check_seed,
    require_field,
    require_type,
)

_FOOT = 0.3048  # [m]


@dataclass
class Wind(Config):
    """Wind at the vehicle: a mean and gusts; calm by default."""

    # [m/s] Mean v_WA of the air in the world frame. Gusts along the wind have its direction, or x.
    mean: list[float] = bounded(lambda: [0.0, 0.0, 0.0], "(-inf, inf) m/s")
    # [m/s] Strength of the gusts: the wind at 6 m height that causes them. Light turbulence has
    # 7.7, moderate 15.4, severe 23.2 (MIL-F-8785C).
    gusts: float = bounded(0.0, "[0, inf) m/s")
    # [m] Height above the ground for the scales of the gusts.
    altitude: float = bounded(10 * _FOOT, f"[{10 * _FOOT}, {1000 * _FOOT}] m")
    # [m/s] Speed of the vehicle through the gusts, which travel with the air.
    airspeed: float = bounded(2.0, "(0, inf) m/s")

    def check(self) -> None:
        require_field(self, "mean", len(self.mean) == 3, "three numbers [m/s]")


def dryden_scales(wind: Wind) -> tuple[np.ndarray, np.ndarray]:
    """Returns lengths (3,) [m] and standard deviations (3,) [m/s] of gusts along the wind, across
    it and up, at low altitude (MIL-F-8785C, 3.7.3)."""
    height = wind.altitude / _FOOT
    level = 0.177 + 0.000823 * height
    lengths = _FOOT * np.array([height / level**1.2, height / level**1.2, height])
    return lengths, 0.1 * wind.gusts * np.array([level**-0.4, level**-0.4, 1.0])


def dryden_filter(wind: Wind, period: float) -> tuple[Any, Any, Any, Any]:
    """Returns A (5, 5), B (5, 5), C (3, 5) and S (5, 5) of gusts y_k = C x_k every `period` [s].

    x_k+1 = A x_k + B n_k and x_0 = S n, with n of N(0, 1), have exactly the joint distribution of
    samples of the continuous process of the spectra of MIL-F-8785C, with T = L / airspeed::

        S_u = sigma² 2 T / pi / (1 + (T w)²)
        S_v = sigma² T / pi (1 + 3 (T w)²) / (1 + (T w)²)²,  and S_w
    """
    lengths, sigmas = dryden_scales(wind)
    u, v, w = wind.airspeed / lengths  # [rad/s]
    forms = [np.array([[-u]]), *(np.array([[-a, 0.0], [a, -a]]) for a in (v, w))]
    roots, steps, starts = [], [], []
    for form in forms:
        noise = np.zeros_like(form)
        noise[0, 0] = 2.0 * u if len(form) == 1 else -form[0, 0]
        covariance = solve_continuous_lyapunov(form, -noise)
        steps.append(expm(period * form))
        # What is left of the stationary covariance.
        roots.append(cholesky(covariance - steps[-1] @ covariance @ steps[-1].T, lower=True))
        starts.append(cholesky(covariance, lower=True))
    across = np.array([[math.sqrt(3.0), 1.0 - math.sqrt(3.0)]])
    C = block_diag(*(s * form for s, form in zip(sigmas, (np.eye(1), across, across), strict=True)))
    return block_diag(*steps), block_diag(*roots), C, block_diag(*starts)


@system_template("DrydenWind_", (float, AutoDiffXd, Expression))
def DrydenWind_(T):
    class DrydenWind(LeafSystem_[T]):
        """Outputs a mean wind with Dryden gusts, see `dryden_filter`.

        .. pydrake_system::

            name: DrydenWind
            output_ports: [wind]

        - ``wind`` (3): v_WA [m/s] of the air in W, held for ``period`` [s].
        - Discrete state (5), see `dryden_filter`: it begins with a draw of its stationary
          distribution, and its noise follows from the seed and the time.
        - Numeric parameter 0 (4): ``[mean (3) [m/s], gusts [m/s]]``. Gusts keep the direction
          of the constructor's mean.

        Supports the scalars float, AutoDiffXd and Expression.
        """

        def __init__(
            self, config: Wind, seed: int = 0, period: float = 0.02, *, converter: Any = None
        ):
            super().__init__(converter=converter)
            require_type(config, Wind, "config")
            config.validate()
            check_seed(seed)
            self._seed, self._period = seed, period
            # In units of `gusts`, a parameter.
            self._A, self._B, C, start = dryden_filter(replace(config, gusts=1.0), period)
            along = np.array([*config.mean[:2], 0.0])
            along = along / np.linalg.norm(along) if along.any() else np.array([1.0, 0.0, 0.0])
            R_WG = np.column_stack([along, np.cross([0.0, 0.0, 1.0], along), [0.0, 0.0, 1.0]])
            self._C = R_WG @ C
            self._parameters = [ConfigParameter(self, T, config, ["mean", "gusts"])]
            state = self.DeclareDiscreteState(BasicVector_[T](start @ self._noise("start")))
            prerequisites = {self.discrete_state_ticket(state), self.all_parameters_ticket()}
            self.DeclareVectorOutputPort("wind", 3, self._calc, prerequisites)
            self.DeclarePeriodicDiscreteUpdateEvent(period, period, self._update)

        SetMean = parameter_setter("mean")
        SetGusts = parameter_setter("gusts")

        def _noise(self, name):
            normal = GaussianVectorX(np.zeros(5), np.ones(5))
            return np.array(draw(normal, self._seed, f"wind {name}"))

        def _update(self, context, discrete_state):
            time = context.get_time()
            time = time.Evaluate() if T is Expression else float_values(time)
            step = round(float(time) / self._period)
            x = context.get_discrete_state_vector().value()
            discrete_state.set_value(self._A @ x + self._B @ self._noise(step))

        def _calc(self, context, output):
            config = self._parameters[0].config(context)
            x = context.get_discrete_state_vector().value()
            output.SetFromVector(np.array(config.mean) + config.gusts * (self._C @ x))

    return DrydenWind


DrydenWind = DrydenWind_[None]
