"""Environments of driving for Stable-Baselines3, in this process.

    from stable_baselines3 import PPO
    from gump.sb3 import Sb3VecEnv
    env = Sb3VecEnv(list(gump.open("scenarios.tfrecord")), num_envs=16)
    PPO("MlpPolicy", env).learn(100_000)

Rasters are 0 or 1 already: `observation="raster"` wants `policy_kwargs={"normalize_images": False}`
and a features extractor for eight channels.
"""

from __future__ import annotations

from typing import Any, List, Sequence, Union

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from . import _native
from .vector_env import _KINDS, VectorEnv
from .worlds import World


class Sb3VecEnv(VecEnv):
    """Many episodes of driving side by side; a row that ends begins its next episode at once.

    Arguments are those of `gump.VectorEnv`. What is known of an episode that ended is in its row's info:
    `terminal_observation`, `TimeLimit.truncated`, `episode`, and beside them what `VectorEnv` tells.
    """

    def __init__(
        self,
        scenarios: Sequence[_native.Scenario],
        num_envs: int = 16,
        world: Union[str, World] = "log",
        **choices: Any,
    ) -> None:
        self.env = VectorEnv(scenarios, num_envs, world, autoreset_mode="same_step", **choices)
        self._actions: Any = None
        self.render_mode = None
        super().__init__(num_envs, self.env.single_observation_space, self.env.single_action_space)

    def reset(self) -> np.ndarray:
        """Starts episodes, with the seeds of `seed()` if it was called since the last time."""
        seeds = None if any(seed is None for seed in self._seeds) else self._seeds
        self._reset_seeds()
        return self.env.reset(seed=seeds)[0]

    def step_async(self, actions: Any) -> None:
        """Takes the actions, `[num_envs, action_len]` in [-1, 1]; `step_wait` does them."""
        self._actions = actions

    def step_wait(self) -> Any:
        """What came of them."""
        observations, rewards, terminated, truncated, extras = self.env.step(self._actions)
        infos: List[Any] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(terminated | truncated):
            info = infos[row]
            info.update({key: extras["final_info"][key][row].item() for key in _KINDS})
            info["terminal_observation"] = extras["final_obs"][row]
            info["TimeLimit.truncated"] = bool(truncated[row])
            info["episode"] = {"r": info["return"], "l": info["steps"]}
        return observations, rewards.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        """Lets the episodes go."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> List[Any]:
        """All rows are one environment, which has one of each attribute."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused: rows have no attributes of their own."""
        raise AttributeError(f"rows of an Sb3VecEnv have no {attr_name} of their own")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> List[Any]:
        """Refused: rows have no methods of their own."""
        raise AttributeError(f"rows of an Sb3VecEnv have no {method_name}() of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> List[bool]:
        """No row is."""
        return [False for _ in self._get_indices(indices)]
