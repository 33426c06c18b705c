"""nuPlan's closed loop and its scores.

`simulate` lets a planner drive: one of ours by name, or any object with nuPlan's two methods,
`initialize(PlannerInitialization)` and `compute_planner_trajectory(PlannerInput)`. What it is given
are the classes below, which bear nuPlan's names where they mean the same and hold arrays.

Poses of the ego are those of its rear axle, as nuPlan's are; everybody else's are box centres.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any, Deque, Dict, List, NamedTuple, Optional, Sequence, Tuple, Union

import numpy as np

from . import _arrays, _native
from .worlds import World, _scenario

EGO_FIELDS = (
    "x",
    "y",
    "heading",
    "velocity_x",
    "velocity_y",
    "acceleration_x",
    "acceleration_y",
    "steering_angle",
    "steering_rate",
    "yaw_rate",
    "yaw_acceleration",
)
"""Columns of an ego array: rear axle in the world frame (metres, radians), velocity and acceleration in
the vehicle's own frame (x ahead, y left), angle and rate of the front wheels, yaw rate and its change."""

_BUFFER = 22
"""Frames that nuPlan's planners see: 2 s of past and the present, at 10 Hz."""


class EgoState(NamedTuple):
    """The ego at its rear axle."""

    time_us: int
    x: float
    y: float
    heading: float
    velocity_x: float = 0.0
    velocity_y: float = 0.0
    acceleration_x: float = 0.0
    acceleration_y: float = 0.0
    steering_angle: float = 0.0
    steering_rate: float = 0.0
    yaw_rate: float = 0.0
    yaw_acceleration: float = 0.0


class Observation(NamedTuple):
    """Everybody but the ego at one moment."""

    agent_id: np.ndarray
    """int64 [A]."""
    kind: List[str]
    """[A]."""
    states: np.ndarray
    """float64 [A, 4]: x, y, z, heading of box centres."""
    velocity: np.ndarray
    """float64 [A, 2]: metres per second, world frame."""
    size: np.ndarray
    """float64 [A, 3]: length, width, height, metres."""
    lights: List[Tuple[int, str]]
    """Lanes and the colours of their lights."""


class Vehicle(NamedTuple):
    """The ego's extents, metres; lengths from the rear axle."""

    width: float
    front_length: float
    rear_length: float
    wheel_base: float
    height: float


@dataclasses.dataclass
class PlannerInitialization:
    """Where to go, and in what."""

    scenario: _native.Scenario
    """The map is `scenario.map`; whoever looks at its log is an oracle."""
    route_lane_ids: List[int]
    route_roadblock_ids: List[int]
    mission_goal: Optional[Tuple[float, float, float]]
    """x, y, heading of the rear axle, if known."""
    vehicle: Vehicle


class Iteration(NamedTuple):
    """A step of the simulation."""

    index: int
    time_us: int

    @property
    def time_s(self) -> float:
        """Seconds."""
        return self.time_us * 1e-6


@dataclasses.dataclass
class History:
    """Up to 2.1 s of what was, oldest first, the present last."""

    ego_states: List[EgoState]
    observations: List[Observation]

    @property
    def current_state(self) -> Tuple[EgoState, Observation]:
        """The present."""
        return self.ego_states[-1], self.observations[-1]


@dataclasses.dataclass
class PlannerInput:
    """What a planner sees at one step."""

    iteration: Iteration
    history: History

    @property
    def ego(self) -> EgoState:
        """The ego now."""
        return self.history.ego_states[-1]

    @property
    def observation(self) -> Observation:
        """Everybody else now."""
        return self.history.observations[-1]


@dataclasses.dataclass(frozen=True)
class Score:
    """A drive's score and its parts."""

    score: float
    """nuPlan's closed-loop score, 0 to 1."""
    metrics: Dict[str, Optional[float]]
    """By nuPlan's names; `None` where a metric has no score."""


@dataclasses.dataclass(frozen=True)
class Simulation(Score):
    """A drive with its score. N executed steps, A agents of `scenario.simulated`, the ego among them."""

    milliseconds_per_step: float
    """What the planner took."""
    time_us: np.ndarray
    """int64 [N]."""
    ego: np.ndarray
    """float64 [N, 11], see `EGO_FIELDS`."""
    agent_id: np.ndarray
    """int64 [A]."""
    others: np.ndarray
    """float64 [A, N, 6]: x, y, z, heading of box centres, velocity; NaN where absent."""


class PlannerError(RuntimeError):
    """A planner that raised, or returned what is no trajectory; its own exception is the cause."""


def simulate(
    scenario: _native.Scenario,
    planner: Any,
    world: Union[str, World] = "idm",
    *,
    seconds: float = 15.0,
    controller: str = "two-stage",
    imagination: Optional[World] = None,
    seed: int = 0,
) -> Simulation:
    """Lets a planner drive through a scenario and scores the drive as nuPlan does.

    `planner` is "pdm-closed", "idm", "simple", "log", "imitation", "interactive", one of
    `gump.planners`, or an object with `initialize` and `compute_planner_trajectory`. `world` moves the
    others: "log" (nuPlan's non-reactive loop), "idm" (its reactive one), "constant-velocity" or a
    `World`. `controller` is "two-stage" (an LQR tracker and a kinematic bicycle) or "perfect".
    `imagination` is the world that planners imagine in who do; reactive rules without it.

    `compute_planner_trajectory` may return an array [N, 3] (x, y, heading of the rear axle every tenth
    of a second from 0.1 s on), an array [N, 4] (seconds from now before them), a sequence of
    `EgoState`, or an object of nuPlan's with `get_sampled_trajectory()`. Two states are needed at
    least, and times must increase.

    Raises `ValueError` for a scenario that cannot be driven through and for arguments out of range,
    `PlannerError` with step and cause for a planner that raises, `TypeError` for one that lacks a
    method.
    """
    if controller not in ("two-stage", "perfect"):
        raise ValueError(f"controller: expected two-stage or perfect, found {controller}")
    world = world if isinstance(world, World) else World(world)
    name = getattr(planner, "_gump_planner", planner)
    if imagination is None:
        imagination = getattr(planner, "imagination", None)
    values = _native.nuplan_simulate(
        _scenario(scenario),
        name if isinstance(name, str) else _Bridge(planner),
        world._world,
        None if imagination is None else imagination._world,
        seconds,
        controller == "perfect",
        seed,
    )
    return Simulation(**values)


def score(
    scenario: _native.Scenario,
    time_us: Any,
    ego: Any,
    agent_id: Any = None,
    others: Any = None,
) -> Score:
    """Scores a drive that was driven elsewhere, beside the recorded driver's.

    `time_us` [N] are increasing microseconds from the present on, `ego` [N, 11] the columns of
    `EGO_FIELDS`, or [N, 3] with x, y, heading alone: the rest is then taken from differences. Others
    replay the log unless `agent_id` [A] and `others` [A, N, 6] (x, y, z, heading, velocity; NaN where
    absent) say where they were.

    Raises `ValueError` for another shape, numbers that are none, agents that are not in the scenario,
    or more steps than were recorded.
    """
    times = _arrays.ids(time_us, "time_us")
    states = _arrays.numbers(ego, "ego", np.float64)
    if states.ndim == 2 and states.shape[1] == 3 and times.shape == states.shape[:1]:
        states = np.ascontiguousarray(_with_motion(times * 1e-6, states)[:, 1:])
    if (agent_id is None) != (others is None):
        raise ValueError("agent_id, others: expected both or neither, found one")
    values = _native.nuplan_score(
        _scenario(scenario),
        times,
        states,
        None if agent_id is None else _arrays.ids(agent_id),
        _arrays.optional(others, "others", np.float64),
    )
    return Score(**values)


class _Bridge:
    """Turns what the simulation tells into what planners read, and their plans into arrays."""

    def __init__(self, planner: Any) -> None:
        for method in ("initialize", "compute_planner_trajectory"):
            if not callable(getattr(planner, method, None)):
                raise TypeError(
                    f"planner: expected an object with initialize and compute_planner_trajectory, "
                    f"found {type(planner).__name__} without {method}"
                )
        self._planner = planner
        self._egos: Deque[EgoState] = deque(maxlen=_BUFFER)
        self._observations: Deque[Observation] = deque(maxlen=_BUFFER)

    def initialize(self, values: Dict[str, Any]) -> None:
        values["vehicle"] = Vehicle(**values["vehicle"])
        self._egos.clear()
        self._observations.clear()
        try:
            self._planner.initialize(PlannerInitialization(**values))
        except Exception as error:
            raise PlannerError(f"{self._name()} raised {_sentence(error)} in initialize") from error

    def plan(self, values: Dict[str, Any]) -> np.ndarray:
        if values["before"] is not None:
            egos, observations = values["before"]
            self._egos.extend(EgoState(time_us, *row) for time_us, row in egos)
            self._observations.extend(Observation(**one) for one in observations)
        self._egos.append(EgoState(values["time_us"], *values["ego"]))
        self._observations.append(Observation(**values["observed"]))
        iteration = Iteration(values["iteration"], values["time_us"])
        history = History(list(self._egos), list(self._observations))
        try:
            plan = self._planner.compute_planner_trajectory(PlannerInput(iteration, history))
            return _rows(plan, self._egos[-1])
        except Exception as error:
            raise PlannerError(f"{self._name()} raised {_sentence(error)} at step {iteration.index}") from error

    def _name(self) -> str:
        name = getattr(self._planner, "name", None)
        return name() if callable(name) else type(self._planner).__name__


def _sentence(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _rows(plan: Any, now: EgoState) -> np.ndarray:
    """A plan as float64 [N, 12]: seconds from now and the columns of `EGO_FIELDS`."""
    sampled = getattr(plan, "get_sampled_trajectory", None)
    if callable(sampled):
        return np.array([_devkit_row(state, now.time_us) for state in sampled()], np.float64)
    if isinstance(plan, Sequence) and plan and all(isinstance(state, EgoState) for state in plan):
        return np.array([((state.time_us - now.time_us) * 1e-6, *state[1:]) for state in plan], np.float64)
    rows = _arrays.numbers(plan, "the trajectory", np.float64)
    if rows.ndim != 2 or rows.shape[1] not in (3, 4):
        raise ValueError(f"expected a trajectory of shape [N, 3] or [N, 4], found {list(rows.shape)}")
    if not np.isfinite(rows).all():
        raise ValueError("expected a trajectory of numbers, found one that is not finite")
    if rows.shape[1] == 3:
        rows = np.column_stack([0.1 * np.arange(1, len(rows) + 1), rows])
    if len(rows) == 0:
        raise ValueError("expected a trajectory of at least 1 state, found none")
    if rows[0, 0] > 0.0:
        rows = np.vstack([[0.0, now.x, now.y, now.heading], rows])
        found = _with_motion(rows[:, 0], rows[:, 1:])
        found[0, 1:] = now[1:]
        return found
    return _with_motion(rows[:, 0], rows[:, 1:])


def _with_motion(seconds: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Velocities and the like from differences of poses [N, 3]."""
    rows = np.zeros((len(poses), 12))
    rows[:, 0] = seconds
    rows[:, 1:4] = poses
    if len(poses) < 2:
        return rows
    heading = np.unwrap(poses[:, 2])
    cos, sin = np.cos(heading), np.sin(heading)

    def into_vehicle(vectors: np.ndarray) -> np.ndarray:
        return np.column_stack([cos * vectors[:, 0] + sin * vectors[:, 1], cos * vectors[:, 1] - sin * vectors[:, 0]])

    with np.errstate(divide="ignore", invalid="ignore"):
        velocity = np.gradient(poses[:, :2], seconds, axis=0)
        acceleration = np.gradient(velocity, seconds, axis=0)
        rate = np.gradient(heading, seconds)
        rows[:, 4:6] = into_vehicle(velocity)
        rows[:, 6:8] = into_vehicle(acceleration)
        rows[:, 10] = rate
        rows[:, 11] = np.gradient(rate, seconds)
    return rows


def _devkit_row(state: Any, now_us: int) -> Tuple[float, ...]:
    """A state of nuplan-devkit's `EgoState`."""
    axle, dynamic = state.rear_axle, state.dynamic_car_state
    velocity, acceleration = dynamic.rear_axle_velocity_2d, dynamic.rear_axle_acceleration_2d
    return (
        (state.time_us - now_us) * 1e-6,
        axle.x,
        axle.y,
        axle.heading,
        velocity.x,
        velocity.y,
        acceleration.x,
        acceleration.y,
        state.tire_steering_angle,
        dynamic.tire_steering_rate,
        dynamic.angular_velocity,
        dynamic.angular_acceleration,
    )
