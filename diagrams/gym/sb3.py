"""VectorFlightEnv for Stable-Baselines3, which has its own interface of many environments."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from splatpilot.diagrams.gym.vector_env import VectorFlightEnv
from splatpilot.systems.common.validation import require


class Sb3FlightEnv(VecEnv):
    """Makes many flights the `VecEnv` of a trainer of Stable-Baselines3.

        model = PPO("MultiInputPolicy", Sb3FlightEnv(64, "P01", num_worlds=16))

    At the end of each flight its info has `is_success`, `outcome`, the number `scenario`, and as
    `episode` the sum `r` of its rewards and the number `l` of its steps, which trainers report. For
    a curriculum, call `set_attr("choices", ...)`, see `VectorFlightEnv.choices`.

    Args:
        num_envs, scenario, fields: of `VectorFlightEnv`.
    """

    def __init__(self, num_envs: int, scenario: Any = "P01", **fields: Any) -> None:
        require("autoreset_mode" not in fields, "autoreset_mode", "left out", "one")
        mode = AutoresetMode.SAME_STEP
        self.envs = VectorFlightEnv(num_envs, scenario, autoreset_mode=mode, **fields)
        self.render_mode = self.envs.render_mode
        spaces = self.envs.single_observation_space, self.envs.single_action_space
        super().__init__(num_envs, *spaces)
        self._returns, self._lengths = np.zeros(num_envs), np.zeros(num_envs, int)
        self._actions = np.zeros(0)

    def reset(self) -> Any:
        seed = self._seeds[0] if self._seeds else None
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        return self.envs.reset(seed=seed)[0]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observed, rewards, terminated, truncated, given = self.envs.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(ended):
            last = given["final_info"]
            infos[i] = {
                "terminal_observation": given["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "outcome": str(last["outcome"][i]),
                "is_success": bool(last["is_success"][i]),
                "scenario": int(last["scenario"][i]),
                "episode": {"r": self._returns[i], "l": int(self._lengths[i]), "t": 0.0},
            }
        self._returns[ended], self._lengths[ended] = 0.0, 0
        return observed, rewards.astype(np.float32), ended, infos

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns the images of `render_mode="rgb_array"`."""
        return list(self.envs.render() or [None] * self.num_envs)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns an attribute of the environments, which they share."""
        return [getattr(self.envs, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets `choices` of the environments; they take others as arguments alone."""
        what = "an argument of Sb3FlightEnv"
        require(attr_name == "choices", attr_name, what, "it by set_attr")
        self.envs.choices = value

    def set_options(self, options: Any = None) -> None:
        """Refuses options, since flights begin without a reset of the trainer."""
        require(not options, "options", "left out; use FlightEnv or VectorFlightEnv", options)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **options: Any) -> list:
        """Calls a method of the environments once."""
        result = getattr(self.envs, method_name)(*args, **options)
        return [result] * len(self._rows(indices))

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Returns True for `Monitor` alone, whose infos these environments have."""
        return [wrapper_class is Monitor] * len(self._rows(indices))

    def _rows(self, indices: Any) -> list[int]:
        return list(self._get_indices(indices))
