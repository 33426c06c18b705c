"""Driving environments of gump for Stable-Baselines3.

Stable-Baselines3 has vectorised environments of its own kind; this is gump's in that kind, over
`gump_env.py`, which must lie beside it.

    cargo xtask rl serve --socket /tmp/gump.sock --scenarios DIR --world log

    from stable_baselines3 import PPO
    from gump_sb3 import GumpSb3VecEnv
    env = GumpSb3VecEnv("/tmp/gump.sock", num_envs=16)
    PPO("MlpPolicy", env).learn(100_000)

Rasters are 0 or 1 already: `observation="raster"` wants `policy_kwargs={"normalize_images": False}`
and a features extractor for eight channels.
"""

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from gump_env import GumpVectorEnv

_TOLD = ("scenario", "steps", "return", "progress", "collided", "off_road", "uncomfortable")


class GumpSb3VecEnv(VecEnv):
    """Many episodes of driving side by side; a row that ends begins its next episode at once.

    What Stable-Baselines3 wants to know about an episode that ended is in its row's info:
    `terminal_observation`, `TimeLimit.truncated`, and `episode` for its own statistics; beside them
    what `GumpVectorEnv` tells.
    """

    def __init__(self, path, num_envs=16, observation="vector", dynamics="bicycle"):
        self.env = GumpVectorEnv(path, num_envs, "same_step", observation, dynamics)
        self._actions = None
        self.render_mode = None
        super().__init__(num_envs, self.env.single_observation_space, self.env.single_action_space)

    def reset(self):
        """Starts episodes, with the seeds of `seed()` if it was called since the last time."""
        seeds = None if any(seed is None for seed in self._seeds) else self._seeds
        self._reset_seeds()
        return self.env.reset(seed=seeds)[0]

    def step_async(self, actions):
        """Takes the actions, `[num_envs, action_len]` in [-1, 1]; `step_wait` sends them."""
        self._actions = actions

    def step_wait(self):
        """What came of them."""
        observations, rewards, terminated, truncated, extras = self.env.step(self._actions)
        infos = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(terminated | truncated):
            info = infos[row]
            info.update({key: extras["final_info"][key][row].item() for key in _TOLD})
            info["terminal_observation"] = extras["final_obs"][row]
            info["TimeLimit.truncated"] = bool(truncated[row])
            info["episode"] = {"r": info["return"], "l": info["steps"]}
        return observations, rewards.astype(np.float32), terminated | truncated, infos

    def close(self):
        """Says goodbye."""
        self.env.close()

    def get_attr(self, attr_name, indices=None):
        """All rows are one environment, which has one of each attribute."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name, value, indices=None):
        """Refused: rows have no attributes of their own."""
        raise AttributeError(f"rows of a GumpSb3VecEnv have no {attr_name} of their own")

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        """Refused: rows have no methods of their own."""
        raise AttributeError(f"rows of a GumpSb3VecEnv have no {method_name}() of their own")

    def env_is_wrapped(self, wrapper_class, indices=None):
        """No row is."""
        return [False for _ in self._get_indices(indices)]
