"""In place of TrajTok's fast metric: `fast_sim_agents_metrics.metrics` and `fast_wosac_metric`.

What TrajTok prepares of a scenario in advance is not needed: wherever it takes that dictionary, give a
`gump.Scenario`, the message or its bytes.
"""

from __future__ import annotations

from typing import Any, Dict, Sequence

import numpy as np

from .. import _arrays, wosac
from . import waymo
from ._running import Running, tensor


def compute_scenario_metrics_for_bundle(
    config: Any, gt_scenario: Any, scenario_rollouts: Dict[str, Any], version: str = "2025"
) -> Any:
    """Scores the rollouts of a scenario: `scenario_rollouts` has `simulated_states` [R, A, T, 4] (x, y, z,
    heading) and `agent_id` [A].

    `version` is "2024" or "2025"; `config` may be `None`, or settings as `gump.compat.waymo` takes them, which
    then hold instead. Gives what `gump.compat.waymo` gives. Raises as `gump.wosac.score`, and `KeyError` for
    a dictionary without these two.
    """
    year = version if config is None else waymo._settings(config, waymo.ChallengeType.SIM_AGENTS)
    states, agent_id = scenario_rollouts["simulated_states"], scenario_rollouts["agent_id"]
    scores = wosac.score(waymo._scenario(gt_scenario), agent_id, states, year)
    return waymo._message("SimAgentMetrics", scores, waymo._METRIC_FIELDS)


class WOSACMetric:
    """Mean realism over scenarios; `version` is "2024" or "2025"."""

    def __init__(self, version: str = "2025") -> None:
        self.version = version
        names = [name for name in waymo._METRIC_FIELDS if name != "scenario_id"]
        if "traffic_light_violation_likelihood" not in wosac.weights(version):
            names = [name for name in names if "traffic_light" not in name]
        self._running = Running(names)

    def update(
        self, scenario_id: Sequence[Any], gt_scenarios: Sequence[Any], agent_id: Any, agent_batch: Any, simulated_states: Any
    ) -> None:
        """Adds a batch: agents of all scenarios follow one another in `agent_id` [A], `agent_batch` [A] and
        `simulated_states` [R, A, T, 4]. `scenario_id` is not looked at: scenarios know their names.

        Raises as `gump.wosac.score`.
        """
        states = _arrays.numbers(simulated_states, "simulated_states")
        batch, agents = _arrays.ids(agent_batch, "agent_batch"), _arrays.ids(agent_id)
        if states.ndim != 4 or batch.shape != agents.shape or states.shape[1:2] != agents.shape:
            raise ValueError(
                f"simulated_states: expected shape [R, {len(agents)}, T, 4], one agent per agent_id and agent_batch, "
                f"found {list(states.shape)}"
            )
        scenarios = [waymo._scenario(scenario) for scenario in gt_scenarios]
        rows = [np.flatnonzero(batch == i) for i in range(len(scenarios))]
        found = wosac.score_many(scenarios, [agents[own] for own in rows], [states[:, own] for own in rows], self.version)
        for scores in found:
            self._running.add(scores)

    def compute(self) -> Dict[str, Any]:
        """The means by Waymo's names: tensors where PyTorch is loaded. Raises `ValueError` without any
        scenario."""
        return {name: tensor(number) for name, number in self._running.means().items()}

    def reset(self) -> None:
        """Forgets all scenarios."""
        self._running.reset()
