"""Environments of driving in this process: for Gymnasium, Stable-Baselines3 and loops of one's own.

What they observe, do and earn is what `cargo xtask rl serve` serves over a socket; nothing else changes
when one replaces the other. With gymnasium installed `VectorEnv` is a `gymnasium.vector.VectorEnv` and
`Env` a `gymnasium.Env`; without it they have the same methods.
"""

from __future__ import annotations

from typing import Any, Dict, List, Optional, Sequence, Tuple, Union

import numpy as np

from . import _arrays, _native
from .worlds import World, _scenario

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space

    _VectorBase: Any = gymnasium.vector.VectorEnv
    _Base: Any = gymnasium.Env
except ImportError:
    gymnasium = None  # type: ignore[assignment]
    _VectorBase = _Base = object

_KINDS: Dict[str, type] = {
    "scenario": int,
    "steps": int,
    "return": float,
    "progress": float,
    "collided": bool,
    "at_fault": bool,
    "off_road": bool,
    "uncomfortable": bool,
}


class VectorEnv(_VectorBase):
    """Many episodes of driving side by side, the ego of each driven by actions.

    `scenarios` is what is driven through: a list, or whatever iterates over some. `world` moves the
    others: "log" replays what was recorded, a `World` may react. Observations are float32 `[num_envs,
    numbers]` ("vector") or uint8 0 or 1 `[num_envs, layer, row, column]` ("raster"); actions float32
    `[num_envs, action_len]` in [-1, 1], of a "bicycle" (acceleration, steering), the "next_pose" or a
    "trajectory". An action is held for half a second; an episode is cut off after `horizon` seconds.
    `prioritized` drives scenarios that were failed lately more often. `nearest` limits a world to the
    agents that come nearest to the ego in the log; the others follow the log, which makes steps in a
    learned world faster.

    When an episode ends, `infos` tells its scenario (an index), steps, return, metres of progress, and
    whether it collided, did so at its fault (neither standing nor hit from behind), left the road or
    was uncomfortable; with `autoreset_mode="same_step"` under `final_info`, as Gymnasium has it.

    Raises `ValueError` for no scenarios, one that cannot be driven through, and choices that do not
    exist; later for actions of another shape or out of range, a step before the first reset, and an
    environment that was closed.
    """

    def __init__(
        self,
        scenarios: Sequence[_native.Scenario],
        num_envs: int = 1,
        world: Union[str, World] = "log",
        *,
        autoreset_mode: str = "next_step",
        observation: str = "vector",
        dynamics: str = "bicycle",
        horizon: float = 8.0,
        prioritized: bool = False,
        nearest: Optional[int] = None,
    ) -> None:
        world = world if isinstance(world, World) else World(world)
        self.num_envs = num_envs
        self._mode = autoreset_mode
        self._env = _native.Env(
            [_scenario(scenario) for scenario in scenarios],
            world._world,
            num_envs,
            autoreset_mode,
            observation,
            dynamics,
            horizon,
            prioritized,
            nearest,
        )
        self.action_len: int = self._env.action_len
        self.dt: float = self._env.dt
        self.num_scenarios: int = self._env.n_scenarios
        self.observation_shape: Tuple[int, ...] = tuple(self._env.observation_shape)
        self._seeds = np.random.default_rng()
        self._was_reset = False
        if gymnasium:
            box = gymnasium.spaces.Box
            if observation == "raster":
                self.single_observation_space = box(0, 1, self.observation_shape, np.uint8)
            else:
                self.single_observation_space = box(-np.inf, np.inf, self.observation_shape, np.float32)
            self.single_action_space = box(-1.0, 1.0, (self.action_len,), np.float32)
            self.observation_space = batch_space(self.single_observation_space, num_envs)
            self.action_space = batch_space(self.single_action_space, num_envs)
            self.metadata = {"autoreset_mode": AutoresetMode[autoreset_mode.upper()]}
            self.spec = None

    def reset(
        self, *, seed: Union[None, int, Sequence[Optional[int]]] = None, options: Optional[Dict[str, Any]] = None
    ) -> Tuple[np.ndarray, Dict[str, Any]]:
        """Starts episodes. An int seeds the rows with `seed`, `seed + 1`, ...; without a seed rows
        go on to their next episode. `options={"reset_mask": bools}` restarts some rows only."""
        mask = (options or {}).get("reset_mask")
        if isinstance(seed, (int, np.integer)):
            self._seeds = np.random.default_rng(seed)
            seeds: Optional[List[int]] = [int(seed) + i for i in range(self.num_envs)]
        elif seed is None:
            seeds = None if self._was_reset else self._draw(self.num_envs)
        else:
            seeds = [self._draw(1)[0] if one is None else int(one) for one in seed]
        mask = None if mask is None else np.asarray(mask, bool).tolist()
        observations = self._env.reset(seeds, mask)
        self._was_reset = True
        return observations, {}

    def step(self, actions: Any) -> Tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Dict[str, Any]]:
        """One action per row: observations, rewards float64, terminated, truncated, infos."""
        results = self._env.step(_arrays.numbers(actions, "actions"))
        observations, rewards, terminated, truncated, ended = results
        return observations, rewards.astype(np.float64), terminated, truncated, self._infos(ended)

    def expert_actions(self) -> np.ndarray:
        """The actions that come nearest to what the log does next, float32 `[num_envs, action_len]`."""
        return self._env.expert_actions()

    def sample_actions(self, rng: Optional[np.random.Generator] = None) -> np.ndarray:
        """Random actions, for want of a policy."""
        rng = rng or self._seeds
        return rng.uniform(-1.0, 1.0, (self.num_envs, self.action_len)).astype(np.float32)

    def close(self, **_: Any) -> None:
        """Lets the episodes go."""
        self._env.close()

    def __enter__(self) -> "VectorEnv":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def __del__(self) -> None:
        """Nothing is left to be done: the episodes go with the object."""

    def _draw(self, n: int) -> List[int]:
        return self._seeds.integers(0, 2**63, n).tolist()

    def _infos(self, ended: List[Dict[str, Any]]) -> Dict[str, Any]:
        if not ended:
            return {}
        rows = np.zeros(self.num_envs, bool)
        infos: Dict[str, Any] = {key: np.zeros(self.num_envs, kind) for key, kind in _KINDS.items()}
        finals = np.full(self.num_envs, None, object)
        for episode in ended:
            row = episode["row"]
            rows[row] = True
            finals[row] = episode["last"]
            for key in _KINDS:
                infos[key][row] = episode[key]
        infos.update({f"_{key}": rows.copy() for key in _KINDS})
        if self._mode != "same_step":
            return infos
        return {"final_obs": finals, "_final_obs": rows, "final_info": infos, "_final_info": rows.copy()}


class Env(_Base):
    """One episode after another: for libraries that want a plain environment. Arguments and errors are
    those of `VectorEnv`."""

    metadata = {"render_modes": []}

    def __init__(
        self,
        scenarios: Sequence[_native.Scenario],
        world: Union[str, World] = "log",
        *,
        observation: str = "vector",
        dynamics: str = "bicycle",
        horizon: float = 8.0,
    ) -> None:
        self._rows = VectorEnv(
            scenarios,
            1,
            world,
            autoreset_mode="disabled",
            observation=observation,
            dynamics=dynamics,
            horizon=horizon,
        )
        if gymnasium:
            self.observation_space = self._rows.single_observation_space
            self.action_space = self._rows.single_action_space

    def reset(self, *, seed: Optional[int] = None, options: Any = None) -> Tuple[np.ndarray, Dict[str, Any]]:
        """Starts the next episode, or the first of another seed."""
        if gymnasium:
            super().reset(seed=seed)
        observations, infos = self._rows.reset(seed=seed)
        return observations[0], infos

    def step(self, action: Any) -> Tuple[np.ndarray, float, bool, bool, Dict[str, Any]]:
        """One action, `[action_len]` in [-1, 1]."""
        observations, rewards, terminated, truncated, infos = self._rows.step(np.asarray(action)[None])
        infos = {key: value[0] for key, value in infos.items() if not key.startswith("_")}
        return observations[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), infos

    def close(self) -> None:
        """Lets the episode go."""
        self._rows.close()
