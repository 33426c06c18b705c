"""What a scenario holds, as named tuples of arrays. Metres, seconds, radians."""

from __future__ import annotations

from typing import List, NamedTuple, Optional

import numpy as np

LIGHT_STATES = ("unknown", "green", "yellow", "red")
"""Colours by their numbers in `Lights.state`; -1 is a light that was not seen."""


class Tracks(NamedTuple):
    """All agents over time: A agents ascending by id, T frames `dt` apart."""

    agent_id: np.ndarray
    """int64 [A]."""
    kind: List[str]
    """[A]: vehicle, pedestrian, bicycle, traffic_cone, barrier, sign or other."""
    valid: np.ndarray
    """bool [A, T]: whether the agent is there; where it is not, the numbers are NaN."""
    position: np.ndarray
    """float64 [A, T, 3]: box centre, metres."""
    heading: np.ndarray
    """float64 [A, T]: radians counter-clockwise from +x."""
    velocity: np.ndarray
    """float64 [A, T, 2]: metres per second, world frame."""
    size: np.ndarray
    """float64 [A, T, 3]: length, width, height, metres."""


class Lights(NamedTuple):
    """Traffic lights over time: L lanes ascending by id, T frames."""

    lane_id: np.ndarray
    """int64 [L]: the lane that a light rules."""
    state: np.ndarray
    """int8 [L, T]: index into `LIGHT_STATES`, or -1."""
    stop_point: np.ndarray
    """float64 [L, T, 2]: where vehicles stop, metres; NaN where that is not known."""


class Lane(NamedTuple):
    """A lane with its neighbours in the graph."""

    id: int
    kind: str
    """freeway, surface_street, bike_lane or undefined."""
    centerline: np.ndarray
    """float64 [P, 3]: points in the direction of travel, metres."""
    width: float
    """Metres."""
    speed_limit: Optional[float]
    """Metres per second, if stated."""
    in_intersection: bool
    predecessors: List[int]
    successors: List[int]
    left_neighbors: List[int]
    """Of the same direction, nearest first."""
    right_neighbors: List[int]


class Area(NamedTuple):
    """A polygon with a meaning."""

    id: int
    kind: str
    """crosswalk, speed_bump, driveway, stop_line, turn_stop, intersection, walkway or carpark."""
    polygon: np.ndarray
    """float64 [P, 3], metres."""


class StopSign(NamedTuple):
    """A stop sign and the lanes it rules."""

    id: int
    position: np.ndarray
    """float64 [3], metres."""
    lanes: List[int]


class Map(NamedTuple):
    """The road."""

    lanes: List[Lane]
    road_edges: List[np.ndarray]
    """float64 [P, 3] each: borders of the road, which lies on their left."""
    road_lines: List[np.ndarray]
    """float64 [P, 3] each: painted lines."""
    areas: List[Area]
    stop_signs: List[StopSign]
    drivable: List[np.ndarray]
    """float64 [P, 2] each: surfaces a vehicle may be on."""
