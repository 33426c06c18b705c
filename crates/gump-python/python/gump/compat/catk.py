"""In place of CAT-K's `src.smart.metrics.wosac_metrics`.

    from gump.compat.catk import WOSACMetrics
    metrics = WOSACMetrics("val_closed")
    metrics.update(scenario_files, scenario_rollouts)
    print(metrics.compute()["val_closed/wosac/realism_meta_metric"])
"""

from __future__ import annotations

import os
from typing import Any, Dict, List, Sequence, Union

import numpy as np

from .. import _native, _reading, wosac
from . import waymo
from ._running import Running, tensor

_FIELDS = [
    "metametric",
    "average_displacement_error",
    *waymo._KINEMATIC,
    *waymo._INTERACTIVE,
    "distance_to_road_edge_likelihood",
    "offroad_indication_likelihood",
    "min_average_displacement_error",
    "simulated_collision_rate",
    "simulated_offroad_rate",
]
_GROUPS = ["kinematic_metrics", "interactive_metrics", "map_based_metrics"]
_LIGHTS = ["traffic_light_violation_likelihood", "simulated_traffic_light_violation_rate"]


class WOSACMetrics:
    """Mean realism over scenarios, with CAT-K's keys.

    `ego_only` scores the ego alone, as if nobody else had been recorded. CAT-K measures by the challenge of
    2024, so that is what `year` is; with 2025 two more likelihoods are given.
    """

    def __init__(self, prefix: str, ego_only: bool = False, year: wosac.Year = 2024) -> None:
        self.prefix = prefix
        self.ego_only = ego_only
        self.year = year
        has_lights = "traffic_light_violation_likelihood" in wosac.weights(year)
        self._names = _FIELDS + (_LIGHTS if has_lights else [])
        self._running = Running(self._names + _GROUPS)

    def update(
        self, scenario_files: Sequence[Union[str, "os.PathLike[str]", _native.Scenario]], scenario_rollouts: Sequence[Any]
    ) -> None:
        """Adds scenarios: files whose first record is the scenario (or a `gump.Scenario` each), and their
        `ScenarioRollouts` messages, or the bytes of those.

        Raises as `gump.open` and `gump.wosac.score_message`, and `ValueError` for lists of other lengths.
        """
        if len(scenario_files) != len(scenario_rollouts):
            found = len(scenario_rollouts)
            raise ValueError(f"scenario_rollouts: expected {len(scenario_files)}, one per file, found {found}")
        scenarios, ids, states = [], [], []
        for scenario, message in zip(scenario_files, scenario_rollouts):
            if not isinstance(scenario, _native.Scenario):
                with _reading.open(scenario) as reader:
                    scenario = next(reader)
            rollouts = wosac.read_rollouts(waymo._bytes(message, "scenario_rollouts"))
            if rollouts.scenario_id != scenario.id:
                raise ValueError(f"expected rollouts of scenario {scenario.id}, found those of {rollouts.scenario_id}")
            rows = np.arange(len(rollouts.agent_id))
            if self.ego_only:
                scenario = scenario.only(np.array([scenario.ego]))
                rows = np.flatnonzero(rollouts.agent_id == scenario.ego)
            scenarios.append(scenario)
            ids.append(rollouts.agent_id[rows])
            states.append(rollouts.states[:, rows])
        for scores in wosac.score_many(scenarios, ids, states, self.year):
            self._running.add(scores)

    def compute(self) -> Dict[str, Any]:
        """The means, by CAT-K's keys: tensors where PyTorch is loaded. Raises `ValueError` without any
        scenario."""
        means = self._running.means()
        found = {
            "realism_meta_metric": means["metametric"],
            **{name: means[name] for name in _GROUPS},
            "min_ade": means["min_average_displacement_error"],
            "scenario_counter": self._running.total(),
        }
        named = {f"{self.prefix}/wosac/{name}": tensor(number) for name, number in found.items()}
        likelihoods = {f"{self.prefix}/wosac_likelihood/{name}": tensor(means[name]) for name in self._names}
        return {**named, **likelihoods}

    def reset(self) -> None:
        """Forgets all scenarios."""
        self._running.reset()

    def to(self, *_: Any, **__: Any) -> "WOSACMetrics":
        """Nothing of it lies on a device."""
        return self


def get_scenario_rollouts(
    scenario_id: Sequence[str], agent_id: Any, agent_batch: Any, pred_traj: Any, pred_z: Any, pred_head: Any
) -> List[bytes]:
    """The serialized `ScenarioRollouts` messages of a batch: `agent_id` [A], `agent_batch` [A],
    `pred_traj` [A, R, T, 2], `pred_z` and `pred_head` [A, R, T]. Names of scenarios may be CAT-K's rows of
    16 character codes, too. Raises `ValueError` for another shape."""
    from .. import _arrays

    batch = _arrays.ids(agent_batch, "agent_batch")
    agents = _arrays.ids(agent_id)
    position = _arrays.numbers(pred_traj, "pred_traj")
    z, heading = _arrays.numbers(pred_z, "pred_z"), _arrays.numbers(pred_head, "pred_head")
    if position.ndim != 4 or position.shape[-1] != 2:
        raise ValueError(f"pred_traj: expected an array of shape [A, R, T, 2], found {list(position.shape)}")
    for name, array in (("pred_z", z), ("pred_head", heading)):
        if array.shape != position.shape[:3]:
            raise ValueError(f"{name}: expected shape {list(position.shape[:3])}, found {list(array.shape)}")
    states = np.concatenate([position, z[..., None], heading[..., None]], axis=-1).transpose(1, 0, 2, 3)
    messages = []
    for i, name in enumerate(scenario_id):
        if not isinstance(name, str):
            name = "".join(chr(code) for code in _arrays.ids(name, "scenario_id") if code > 0)
        rows = np.flatnonzero(batch == i)
        messages.append(wosac.write_rollouts(name, agents[rows], states[:, rows]))
    return messages
