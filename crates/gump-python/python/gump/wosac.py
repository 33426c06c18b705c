"""Realism as the Waymo Sim Agents Challenge measures it, equal to the official numbers.

Years are "2023-v0", "2023", "2024", "2025" and "2025-generation". In shapes R counts rollouts, A
agents, T the 80 steps of 0.1 s after the present (all 91 for scenario generation); the last axis of
states is x, y, z (box centre, metres) and heading (radians). Official numbers are made of 32
rollouts; `score` takes any number of them.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Union

import numpy as np

from . import _arrays, _native


class Settings(NamedTuple):
    """Settings of one's own in place of a year's."""

    toml: str
    """In the form of the files in `crates/gump-wosac/src/realism/configs`."""


Year = Union[int, str, Settings]

YEARS = ("2023-v0", "2023", "2024", "2025", "2025-generation")


class AgentRealism(NamedTuple):
    """How likely the log of every scored agent is under the rollouts."""

    agent_id: np.ndarray
    """int64 [N]."""
    realism: np.ndarray
    """float64 [N]: weighted mean of an agent's likelihoods, 0 to 1."""
    steps: np.ndarray
    """float64 [N, T]: how likely what was logged at each step is; NaN where nothing counts."""


class Attribution(NamedTuple):
    """What one agent costs in one component."""

    component: str
    agent_id: int
    kind: str
    cost: float
    """Its part in what the meta metric lacks."""
    likelihood: float
    """Geometric mean of the likelihoods of its logged values, 0 to 1."""
    step: Optional[int]
    """The scored step that is least likely, from 0; of an indication the first at which it holds."""
    logged: float
    """The logged value at that step, in the unit of the component."""
    imagined: float
    """The mean of the rollouts at that step; of an indication the share in which it ever holds."""


Blame = Attribution
"""Former name of `Attribution`, until 0.3."""


@dataclasses.dataclass(frozen=True)
class Buckets:
    """The numbers of Waymo's `SimAgentsBucketedMetrics`."""

    realism_meta_metric: float
    kinematic_metrics: float
    interactive_metrics: float
    map_based_metrics: float
    min_ade: float
    """Metres."""
    simulated_collision_rate: float
    simulated_offroad_rate: float
    simulated_traffic_light_violation_rate: Optional[float]
    """Since 2025."""


@dataclasses.dataclass(frozen=True)
class Scores:
    """The numbers of Waymo's `SimAgentMetrics`, of one scenario or on average over many.

    Likelihoods and rates are 0 to 1, displacement errors metres. A number is NaN where nothing could
    be scored, as in the reference.
    """

    scenario_id: str
    metametric: float
    average_displacement_error: float
    min_average_displacement_error: float
    linear_speed_likelihood: float
    linear_acceleration_likelihood: float
    angular_speed_likelihood: float
    angular_acceleration_likelihood: float
    distance_to_nearest_object_likelihood: float
    collision_indication_likelihood: float
    time_to_collision_likelihood: float
    distance_to_road_edge_likelihood: float
    offroad_indication_likelihood: float
    simulated_collision_rate: float
    simulated_offroad_rate: float
    kinematic_metrics: float
    interactive_metrics: float
    map_based_metrics: float
    traffic_light_violation_likelihood: Optional[float] = None
    """Since 2025."""
    simulated_traffic_light_violation_rate: Optional[float] = None
    """Since 2025."""
    leave_one_out: Optional[np.ndarray] = None
    """float64 [R]: the meta metric without rollout r; on request."""
    per_agent: Optional[AgentRealism] = None
    """On request."""
    explanation: Optional[List[Attribution]] = None
    """Largest first; on request."""

    @property
    def buckets(self) -> Buckets:
        """The meta metric and its groups."""
        return Buckets(
            self.metametric,
            self.kinematic_metrics,
            self.interactive_metrics,
            self.map_based_metrics,
            self.min_average_displacement_error,
            self.simulated_collision_rate,
            self.simulated_offroad_rate,
            self.simulated_traffic_light_violation_rate,
        )

    @property
    def rewards(self) -> Optional[np.ndarray]:
        """float64 [R]: what each rollout adds to the meta metric: the mean of `leave_one_out` less
        its own entry. `None` unless `leave_one_out` was asked for."""
        if self.leave_one_out is None:
            return None
        return self.leave_one_out.mean() - self.leave_one_out


_NUMBERS = [field.name for field in dataclasses.fields(Scores)][1:-3]


def _scores(numbers: Dict[str, Any]) -> Scores:
    if "per_agent" in numbers:
        numbers["per_agent"] = AgentRealism(**numbers["per_agent"])
    if "explanation" in numbers:
        numbers["explanation"] = [Attribution(**one) for one in numbers["explanation"]]
    return Scores(**numbers)


def score(
    scenario: _native.Scenario,
    agent_id: Any,
    states: Any,
    year: Year = 2025,
    leave_one_out: bool = False,
    per_agent: bool = False,
    explain: bool = False,
    sizes: Any = None,
    kinds: Optional[Sequence[str]] = None,
) -> Scores:
    """Scores rollouts of one scenario.

    `agent_id` [A] names the agents of `states` [R, A, T, 4]; they must be exactly those of
    `scenario.simulated`, in any order. For "2025-generation" T is 91, and `sizes` [R, A, T, 3]
    (length, width, height) and `kinds` [A] are wanted, too.

    `leave_one_out` also scores the others without each rollout, `per_agent` adds how well each
    agent fits the log, `explain` what lowered the score and when.

    Raises `ValueError` for another shape, an agent that is missing, unknown or doubled, a number that
    is none, no rollouts, or a scenario that the metric is not defined on; `TypeError` for arrays of
    no numbers.
    """
    numbers = _native.wosac_score(
        _scenario(scenario),
        _arrays.ids(agent_id),
        _arrays.numbers(states, "states"),
        _year(year),
        leave_one_out,
        per_agent,
        explain,
        _arrays.optional(sizes, "sizes"),
        None if kinds is None else list(kinds),
    )
    return _scores(numbers)


def score_many(
    scenarios: Sequence[_native.Scenario],
    agent_id: Sequence[Any],
    states: Sequence[Any],
    year: Year = 2025,
) -> List[Scores]:
    """Scores rollouts of many scenarios over all threads: a list of `agent_id` [A] and of `states`
    [R, A, T, 4], one each per scenario. Raises as `score`."""
    numbers = _native.wosac_score_many(
        [_scenario(scenario) for scenario in scenarios],
        [_arrays.ids(one) for one in agent_id],
        [_arrays.numbers(one, "states") for one in states],
        _year(year),
    )
    return [_scores(one) for one in numbers]


def score_batch(
    scenarios: Sequence[_native.Scenario],
    agent_id: Any,
    agent_batch: Any,
    position: Any,
    z: Any,
    heading: Any,
    year: Year = 2025,
) -> List[Scores]:
    """Scores a batch of scenarios in CAT-K's layout over all threads.

    Agents of all scenarios follow one another: `agent_id` [A], `agent_batch` [A] with the index of
    each agent's scenario, `position` [A, R, T, 2] (x, y), `z` [A, R, T], `heading` [A, R, T].
    Raises as `score`.
    """
    numbers = _native.wosac_score_catk(
        [_scenario(scenario) for scenario in scenarios],
        _arrays.ids(agent_id),
        _arrays.ids(agent_batch, "agent_batch"),
        _arrays.numbers(position, "position"),
        _arrays.numbers(z, "z"),
        _arrays.numbers(heading, "heading"),
        _year(year),
    )
    return [_scores(one) for one in numbers]


def score_message(
    scenario: _native.Scenario,
    message: bytes,
    year: Year = 2025,
    leave_one_out: bool = False,
    per_agent: bool = False,
    explain: bool = False,
) -> Scores:
    """Scores a serialized `waymo.open_dataset.ScenarioRollouts` message. Raises as `score`, and
    `DataError` for bytes that are no such message."""
    numbers = _native.wosac_score_message(
        _scenario(scenario), bytes(message), _year(year), leave_one_out, per_agent, explain
    )
    return _scores(numbers)


class RolloutArrays(NamedTuple):
    """What a `ScenarioRollouts` message holds."""

    scenario_id: str
    agent_id: np.ndarray
    """int64 [A]."""
    states: np.ndarray
    """float32 [R, A, T, 4]."""


def read_rollouts(message: bytes) -> RolloutArrays:
    """The arrays of a serialized `waymo.open_dataset.ScenarioRollouts` message, agents in the order of
    its first rollout. Raises `DataError` for bytes that are no such message, and for rollouts whose
    agents or steps differ."""
    return RolloutArrays(*_native.rollouts_from_message(bytes(message)))


def open_rollouts(path: Union[str, "os.PathLike[str]"]) -> List[RolloutArrays]:
    """The rollouts of every scenario in a file: a `ScenarioRollouts` message, a shard of a submission, or
    arrays, as `evaluate wosac --rollouts` takes them:

    - `.npz` with `scenario_id`, `agent_id` [A] and `states` [R, A, T, 4], as `numpy.savez` and
      `numpy.savez_compressed` write it;
    - `.npy` with the JSON beside it that says what its axes are (`futures.npy` of `simulate`);
    - `.parquet`, the table `futures.parquet` of `simulate`.

    An agent that is missing from some step on stays where it was last; one that is missing at first is left
    out. Heights that are not stated are NaN. Raises `FileNotFoundError`, and `DataError` for what is none
    of these.
    """
    return [RolloutArrays(*one) for one in _native.rollouts_from_file(os.fspath(path))]


def write_rollouts(scenario_id: str, agent_id: Any, states: Any) -> bytes:
    """A serialized `ScenarioRollouts` message of `agent_id` [A] and `states` [R, A, T, 4]. Raises
    `ValueError` for another shape and for ids of more than 32 bits."""
    return _native.rollouts_to_message(scenario_id, _arrays.ids(agent_id), _arrays.numbers(states, "states"))


def mean(scores: Sequence[Scores]) -> Scores:
    """The average over scenarios, each counting the same; its `scenario_id` is empty.

    Raises `ValueError` without any scores.
    """
    scores = list(scores)
    if not scores:
        raise ValueError("scores: expected at least one scenario, found none")

    def average(name: str) -> Optional[float]:
        total = 0.0
        for one in scores:
            value = getattr(one, name)
            if value is None:
                return None
            total += value
        return total / len(scores)

    return Scores(scenario_id="", **{name: average(name) for name in _NUMBERS})


def weights(year: Year = 2025) -> Dict[str, float]:
    """What each likelihood weighs in a year's meta metric, by the names of `Scores`."""
    return _native.wosac_weights(_year(year))


def _year(year: Year) -> str:
    return year.toml + "\n" if isinstance(year, Settings) else str(year)


def _scenario(value: Any) -> _native.Scenario:
    if not isinstance(value, _native.Scenario):
        raise TypeError(f"scenario: expected a gump.Scenario, found {type(value).__name__}")
    return value
