"""Between nuplan-devkit's classes and ours: its planners in our simulation, its histories for our scores.

    from gump.compat.nuplan import Planner
    gump.nuplan.simulate(scenario, Planner(devkit_planner, map_api), "idm")

`Planner` needs nuplan-devkit, `MetricsEngine` only objects with the attributes of its classes.
"""

from __future__ import annotations

import importlib
import sys
from typing import Any, Callable, Dict, List, Mapping, Optional, Tuple, Union

import numpy as np

from .. import _native
from .. import nuplan as ours

_STATES = "nuplan.common.actor_state"
_KINDS = {
    "vehicle": "VEHICLE",
    "pedestrian": "PEDESTRIAN",
    "bicycle": "BICYCLE",
    "traffic_cone": "TRAFFIC_CONE",
    "barrier": "BARRIER",
    "sign": "CZONE_SIGN",
    "other": "GENERIC_OBJECT",
}
_STATIC = ("traffic_cone", "barrier", "sign", "other")


class Planner:
    """A planner of nuplan-devkit, to be given to `gump.nuplan.simulate`.

    It is given what the devkit gives: `PlannerInitialization` with `map_api` as given here (most planners want the
    devkit's map of the place), and `PlannerInput` with a history of `EgoState` and `DetectionsTracks`; tokens of
    agents are their ids.

    Raises `ImportError` without nuplan-devkit.
    """

    def __init__(self, planner: Any, map_api: Any = None) -> None:
        self._planner, self._map_api = planner, map_api
        self._devkit = _Devkit()
        self._vehicle: Any = None
        # States stay the same objects from step to step: planners may keep what they derive from them.
        self._known: Dict[int, Tuple[Any, Any]] = {}

    def name(self) -> str:
        """The devkit planner's own name."""
        return self._planner.name()

    def initialize(self, initialization: ours.PlannerInitialization) -> None:
        """Tells where to go."""
        devkit, goal = self._devkit, initialization.mission_goal
        vehicle, self._known = initialization.vehicle, {}
        # The devkit's car has its centre of gravity at this share of its wheel base.
        gravity = vehicle.wheel_base * 1.67 / 3.089
        self._vehicle = devkit.vehicle(
            width=vehicle.width,
            front_length=vehicle.front_length,
            rear_length=vehicle.rear_length,
            cog_position_from_rear_axle=gravity,
            wheel_base=vehicle.wheel_base,
            vehicle_name="ego",
            vehicle_type="recorded",
            height=vehicle.height,
        )
        self._planner.initialize(
            devkit.initialization(
                route_roadblock_ids=[str(block) for block in initialization.route_roadblock_ids],
                mission_goal=None if goal is None else devkit.pose(*goal),
                map_api=self._map_api,
            )
        )

    def compute_planner_trajectory(self, current_input: ours.PlannerInput) -> Any:
        """The devkit planner's trajectory."""
        devkit, history = self._devkit, current_input.history
        moments = [self._moment(*moment) for moment in zip(history.ego_states, history.observations)]
        self._known = {ego.time_us: moment for ego, moment in zip(history.ego_states, moments)}
        egos, observations = [list(column) for column in zip(*moments)]
        times = [ego.time_us for ego in history.ego_states]
        interval = (times[-1] - times[0]) * 1e-6 / max(len(times) - 1, 1)
        buffer = devkit.buffer.initialize_from_list(len(egos), egos, observations, interval or None)
        iteration = current_input.iteration
        return self._planner.compute_planner_trajectory(
            devkit.input(
                iteration=devkit.iteration(devkit.time(iteration.time_us), iteration.index),
                history=buffer,
                traffic_light_data=devkit.lights(current_input.observation, iteration.time_us),
            )
        )

    def _moment(self, ego: ours.EgoState, observed: ours.Observation) -> Tuple[Any, Any]:
        known = self._known.get(ego.time_us)
        if known is not None:
            return known
        return self._devkit.ego(ego, self._vehicle), self._devkit.detections(observed, ego.time_us)


class _Devkit:
    """The classes of nuplan-devkit that are made here."""

    def __init__(self) -> None:
        def of(module: str, *names: str) -> List[Any]:
            found = importlib.import_module(module)
            return [getattr(found, name) for name in names]

        states = f"{_STATES}.state_representation"
        self.pose, self.vector, self.time = of(states, "StateSE2", "StateVector2D", "TimePoint")
        (self.ego_state,) = of(f"{_STATES}.ego_state", "EgoState")
        (self.vehicle,) = of(f"{_STATES}.vehicle_parameters", "VehicleParameters")
        (self.agent,) = of(f"{_STATES}.agent", "Agent")
        (self.static,) = of(f"{_STATES}.static_object", "StaticObject")
        (self.box,) = of(f"{_STATES}.oriented_box", "OrientedBox")
        (self.metadata,) = of(f"{_STATES}.scene_object", "SceneObjectMetadata")
        (self.kind,) = of(f"{_STATES}.tracked_objects_types", "TrackedObjectType")
        (self.tracked,) = of(f"{_STATES}.tracked_objects", "TrackedObjects")
        simulation = "nuplan.planning.simulation"
        (self.tracks,) = of(f"{simulation}.observation.observation_type", "DetectionsTracks")
        (self.buffer,) = of(f"{simulation}.history.simulation_history_buffer", "SimulationHistoryBuffer")
        planner = f"{simulation}.planner.abstract_planner"
        self.initialization, self.input = of(planner, "PlannerInitialization", "PlannerInput")
        (self.iteration,) = of(f"{simulation}.simulation_time_controller.simulation_iteration", "SimulationIteration")
        maps = "nuplan.common.maps.maps_datatypes"
        self.light, self.colour = of(maps, "TrafficLightStatusData", "TrafficLightStatusType")

    def ego(self, ego: ours.EgoState, vehicle: Any) -> Any:
        return self.ego_state.build_from_rear_axle(
            rear_axle_pose=self.pose(ego.x, ego.y, ego.heading),
            rear_axle_velocity_2d=self.vector(ego.velocity_x, ego.velocity_y),
            rear_axle_acceleration_2d=self.vector(ego.acceleration_x, ego.acceleration_y),
            tire_steering_angle=ego.steering_angle,
            time_point=self.time(ego.time_us),
            vehicle_parameters=vehicle,
            angular_vel=ego.yaw_rate,
            angular_accel=ego.yaw_acceleration,
            tire_steering_rate=ego.steering_rate,
        )

    def detections(self, observed: ours.Observation, time_us: int) -> Any:
        columns = zip(observed.agent_id, observed.kind, observed.states, observed.velocity, observed.size)
        return self.tracks(self.tracked([self._object(time_us, *row) for row in columns]))

    def _object(self, time_us: int, agent_id: Any, kind: str, state: Any, velocity: Any, size: Any) -> Any:
        token = str(agent_id)
        x, y, _, heading = (float(number) for number in state)
        box = self.box(self.pose(x, y, heading), *(float(number) for number in size))
        metadata = self.metadata(timestamp_us=time_us, token=token, track_id=int(agent_id), track_token=token)
        kind_there = self.kind[_KINDS[kind]]
        if kind in _STATIC:
            return self.static(kind_there, box, metadata)
        return self.agent(kind_there, box, self.vector(*(float(number) for number in velocity)), metadata)

    def lights(self, observed: ours.Observation, time_us: int) -> List[Any]:
        return [self.light(self.colour[colour.upper()], lane, time_us) for lane, colour in observed.lights]


class MetricsEngine:
    """In place of the devkit's `MetricsEngine`: scores a `SimulationHistory` with our metrics.

    `scenarios` are ours by the devkit scenario's token, or a function from the devkit's scenario to ours: the devkit
    alone knows neither our map nor our log. `agent_of` says which of our agents a track token is (`None`: none of
    them), for what is met in the history; by default a token is the agent's id, as `Planner` has it. Without anybody
    who is known, others are taken to replay the log.
    """

    def __init__(
        self,
        scenarios: Union[Mapping[str, _native.Scenario], Callable[[Any], _native.Scenario]],
        agent_of: Optional[Callable[[str], Optional[int]]] = None,
    ) -> None:
        self._scenarios = scenarios
        self._agent_of = agent_of or (lambda token: int(token) if token.lstrip("-").isdigit() else None)

    def score(self, history: Any, scenario: Any) -> ours.Score:
        """The scores of a history. Raises `KeyError` for a scenario that is not among ours, and as
        `gump.nuplan.score`."""
        own = self._scenarios(scenario) if callable(self._scenarios) else self._scenarios[scenario.token]
        samples = history.data
        rows = np.array([ours._devkit_row(sample.ego_state, 0) for sample in samples], np.float64)
        time_us = np.array([sample.ego_state.time_us for sample in samples], np.int64)
        ids, others = self._others(own, samples)
        if not len(ids):
            return ours.score(own, time_us, rows[:, 1:])
        return ours.score(own, time_us, rows[:, 1:], ids, others)

    def compute(self, history: Any, scenario: Any, planner_name: str) -> Dict[str, List[Any]]:
        """The scores by the devkit's name of the simulation: `MetricFile`s with a score each where nuplan-devkit is
        loaded, else pairs of a metric's name and its score. Statistics and time series are not given."""
        found = self.score(history, scenario)
        name = f"{scenario.scenario_type}_{scenario.scenario_name}_{planner_name}"
        if "nuplan.planning" not in sys.modules:
            return {name: list(found.metrics.items())}
        files = importlib.import_module("nuplan.planning.metrics.metric_file")
        results = importlib.import_module("nuplan.planning.metrics.metric_result")

        def file(metric: str, score: Optional[float]) -> Any:
            key = files.MetricFileKey(
                metric_name=metric,
                log_name=scenario.log_name,
                scenario_name=scenario.scenario_name,
                scenario_type=scenario.scenario_type,
                planner_name=planner_name,
            )
            result = results.MetricStatistics(
                metric_computator=metric,
                name=metric,
                metric_category="Planning",
                statistics=[],
                metric_score=score,
                metric_score_unit="float",
            )
            return files.MetricFile(key=key, metric_statistics=[result])

        return {name: [file(metric, score) for metric, score in found.metrics.items()]}

    def _others(self, own: _native.Scenario, samples: Any) -> Tuple[np.ndarray, np.ndarray]:
        """Ids [A] and states [A, N, 6] of whom we know, NaN where absent."""
        rows: Dict[int, np.ndarray] = {}
        for step, sample in enumerate(samples):
            for one in sample.observation.tracked_objects:
                agent = self._agent_of(one.track_token)
                if agent is None or agent == own.ego:
                    continue
                states = rows.setdefault(agent, np.full((len(samples), 6), np.nan))
                velocity = one.velocity
                states[step] = one.center.x, one.center.y, 0.0, one.center.heading, velocity.x, velocity.y
        return np.array(list(rows), np.int64), np.array(list(rows.values()), np.float64)
