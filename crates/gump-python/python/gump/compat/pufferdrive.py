"""In place of PufferDrive's `pufferlib.ocean.benchmark.evaluator.WOSACEvaluator`: its `compute_metrics`.

The numbers are Waymo's, computed on what PufferDrive hands over: boxes without heights in the plane, road edges, and
nothing else of the map. All agents are taken for vehicles unless `agent_state` has a `kind`.
"""

from __future__ import annotations

import struct
from typing import Any, Dict, Iterable, List, Optional, Sequence

import numpy as np

from .. import _arrays, _native, _reading, wosac

_PAST, _FUTURE = 10, 80
"""Steps before and after the present in Waymo's scenarios."""
_KINDS = {"vehicle": 1, "pedestrian": 2, "bicycle": 3, "cyclist": 3, "other": 4}
_LIKELIHOODS = (
    "linear_speed",
    "linear_acceleration",
    "angular_speed",
    "angular_acceleration",
    "distance_to_nearest_object",
    "time_to_collision",
    "collision_indication",
    "distance_to_road_edge",
    "offroad_indication",
)


class WOSACEvaluator:
    """Scores rollouts of many scenarios; `config` is not looked at.

    `year` is that of the settings. PufferDrive knows no traffic lights, so those of 2024, which ask for none, are
    taken unless it says another.
    """

    def __init__(self, config: Optional[Dict[str, Any]] = None, year: wosac.Year = 2024) -> None:
        self.config = config
        self.year = year

    def compute_metrics(
        self,
        ground_truth_trajectories: Dict[str, Any],
        simulated_trajectories: Dict[str, Any],
        agent_state: Dict[str, Any],
        road_edge_polylines: Dict[str, Any],
        aggregate_results: bool = False,
    ) -> Any:
        """Scores A agents of all scenarios at once.

        `ground_truth_trajectories` has x, y, heading and valid [A, 1, T], id [A, 1] (those below 0 are met but not
        judged) and scenario_id [A, 1]; `simulated_trajectories` has x, y, heading [A, R, T] and id [A, R, T]. T is 91,
        of which the first 10 are the past and the next the present, or 81 from the present on. `agent_state` has
        length and width [A]; `road_edge_polylines` has x and y of all points one after another, lengths and
        scenario_id of the polylines, the road on their left. Metres and radians; z is not looked at, as there.

        Gives a table with one row per scenario (a `pandas.DataFrame` where pandas can be had, else a dictionary of
        dictionaries by scenario), with PufferDrive's names; with `aggregate_results` a dictionary of means. Collisions
        and drives off the road of the log are not given. Agents that are absent at the present are left out.

        Raises `ValueError` for other shapes and ids that differ, `KeyError` for a dictionary without one of these,
        and as `gump.wosac.score`.
        """
        batch = _Batch(ground_truth_trajectories, simulated_trajectories, agent_state)
        edges = _Edges(road_edge_polylines)
        rows: Dict[Any, Dict[str, float]] = {}
        names = list(dict.fromkeys(batch.scenario_id.tolist()))
        built = [batch.scenario(name, edges) for name in names]
        found = wosac.score_many(
            [scenario for scenario, _ in built],
            [scenario.simulated for scenario, _ in built],
            [states for _, states in built],
            self.year,
        )
        for name, scores, (scenario, states) in zip(names, found, built):
            rows[name] = _row(scores, len(scenario.targets), len(states))
        if not aggregate_results:
            return _table(rows)
        columns = list(next(iter(rows.values())))
        means = {column: float(np.mean([row[column] for row in rows.values()])) for column in columns}
        means["total_num_agents"] = int(sum(row["num_agents"] for row in rows.values()))
        return means


class _Batch:
    """Agents of all scenarios, one after another."""

    def __init__(self, truth: Dict[str, Any], simulated: Dict[str, Any], state: Dict[str, Any]) -> None:
        self.log = [_arrays.numbers(truth[name], name, np.float64) for name in ("x", "y", "heading")]
        self.rollouts = [_arrays.numbers(simulated[name], name) for name in ("x", "y", "heading")]
        agents, n_rollouts, steps = self._shape()
        self.present = steps - _FUTURE - 1
        self.valid = np.asarray(truth["valid"]).astype(bool).reshape(agents, steps)
        self.ids = _arrays.ids(truth["id"], "id").reshape(agents)
        self.scenario_id = np.asarray(truth["scenario_id"]).reshape(agents)
        ids = _arrays.ids(simulated["id"], "id").reshape(agents, n_rollouts, -1)[:, 0, 0]
        if (ids != self.ids).any():
            at = int(np.flatnonzero(ids != self.ids)[0])
            raise ValueError(f"id: expected {self.ids[at]} for agent {at} as in the log, found {ids[at]}")
        self.sizes = [_arrays.numbers(state[name], name, np.float64).reshape(agents) for name in ("length", "width")]
        self.kinds = [_kind(kind) for kind in state.get("kind", ["vehicle"] * agents)]

    def _shape(self) -> Sequence[int]:
        shape = self.rollouts[0].shape
        if len(shape) != 3 or shape[2] not in (_FUTURE + 1, _PAST + _FUTURE + 1):
            raise ValueError(f"x: expected an array of shape [A, R, 81] or [A, R, 91], found {list(shape)}")
        for name, log, rollouts in zip(("x", "y", "heading"), self.log, self.rollouts):
            if rollouts.shape != shape:
                raise ValueError(f"{name}: expected rollouts of shape {list(shape)}, found {list(rollouts.shape)}")
            if log.shape != (shape[0], 1, shape[2]):
                raise ValueError(f"{name}: expected a log of shape {[shape[0], 1, shape[2]]}, found {list(log.shape)}")
        return shape

    def scenario(self, name: Any, edges: _Edges) -> Any:
        """One scenario and the states [R, A, 80, 4] of those who are there at its present."""
        there = self.valid[:, self.present]
        rows = np.flatnonzero((self.scenario_id == name) & there)
        if not (self.ids[rows] >= 0).any():
            raise ValueError(f"scenario {name}: expected an agent with an id of 0 or more at the present, found none")
        tracks = b"".join(_field(2, self._track(number, row)) for number, row in enumerate(rows))
        judged = np.flatnonzero(self.ids[rows] >= 0).tolist()
        message = b"".join(_double(1, 0.1 * step) for step in range(_PAST + _FUTURE + 1))
        message += tracks + _field(5, str(name).encode()) + _varint_field(6, judged[0])
        message += edges.features(name) + _varint_field(10, _PAST)
        message += b"".join(_field(11, _varint_field(1, track)) for track in judged)
        x, y, heading = (array[rows, :, self.present + 1 :] for array in self.rollouts)
        states = np.stack([x, y, np.zeros_like(x), heading], axis=-1).transpose(1, 0, 2, 3)
        return _reading.read(message), np.ascontiguousarray(states)

    def _track(self, number: int, row: int) -> bytes:
        absent = _field(3, _varint_field(11, 0))
        states = [absent] * (_PAST - self.present)
        x, y, heading = (array[row, 0] for array in self.log)
        length, width = (size[row] for size in self.sizes)
        size = _float(5, length) + _float(6, width) + _float(7, 1.0)
        for step in range(len(x)):
            if not self.valid[row, step]:
                states.append(absent)
                continue
            # Velocities are not given; the metric takes its own from positions.
            place = _double(2, x[step]) + _double(3, y[step]) + _double(4, 0.0)
            states.append(_field(3, place + size + _float(8, heading[step]) + _varint_field(11, 1)))
        return _varint_field(1, number) + _varint_field(2, self.kinds[row]) + b"".join(states)


class _Edges:
    """Road edges of all scenarios."""

    def __init__(self, values: Dict[str, Any]) -> None:
        lengths = _arrays.ids(values["lengths"], "lengths").ravel()
        points = [_arrays.numbers(values[name], name, np.float64).ravel() for name in ("x", "y")]
        if len(points[0]) != lengths.sum() or len(points[1]) != lengths.sum():
            found = f"{len(points[0])} and {len(points[1])}"
            raise ValueError(f"road_edge_polylines: expected {lengths.sum()} x and y as lengths say, found {found}")
        self._scenario_id = np.asarray(values["scenario_id"]).ravel()
        if len(self._scenario_id) != len(lengths):
            found = len(self._scenario_id)
            raise ValueError(f"road_edge_polylines: expected {len(lengths)} scenario_id, one per polyline, found {found}")
        ends = np.cumsum(lengths)
        self._lines = [np.column_stack([axis[end - n : end] for axis in points]) for n, end in zip(lengths, ends)]

    def features(self, name: Any) -> bytes:
        """The map of one scenario."""
        own = [line for line, of in zip(self._lines, self._scenario_id) if of == name]
        return b"".join(_field(8, _varint_field(1, i + 1) + _field(5, _edge(line))) for i, line in enumerate(own))


def _edge(line: np.ndarray) -> bytes:
    points: Iterable[bytes] = (_field(2, _double(1, x) + _double(2, y) + _double(3, 0.0)) for x, y in line)
    return _varint_field(1, 1) + b"".join(points)


def _kind(kind: Any) -> int:
    number = kind if isinstance(kind, (int, np.integer)) else _KINDS.get(kind)
    if number not in _KINDS.values():
        raise ValueError(f"kind: expected vehicle, pedestrian, bicycle or other, found {kind}")
    return int(number)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes(out) + bytes([value])


def _varint_field(number: int, value: int) -> bytes:
    return _varint(number << 3) + _varint(value)


def _field(number: int, content: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _double(number: int, value: float) -> bytes:
    return _varint(number << 3 | 1) + struct.pack("<d", value)


def _float(number: int, value: float) -> bytes:
    return _varint(number << 3 | 5) + struct.pack("<f", value)


def _row(scores: wosac.Scores, agents: int, rollouts: int) -> Dict[str, float]:
    row: Dict[str, float] = {
        "num_agents": agents,
        "ade": scores.average_displacement_error,
        "min_ade": scores.min_average_displacement_error,
        # Rollouts in which it happens, on average over agents.
        "num_collisions_sim": scores.simulated_collision_rate * rollouts,
        "num_offroad_sim": scores.simulated_offroad_rate * rollouts,
    }
    row.update({f"likelihood_{name}": getattr(scores, f"{name}_likelihood") for name in _LIKELIHOODS})
    row["realism_meta_score"] = scores.metametric
    return row


def _table(rows: Dict[Any, Dict[str, float]]) -> Any:
    try:
        import pandas
    except ImportError:
        return rows
    table = pandas.DataFrame.from_dict(rows, orient="index")
    table.index.name = "scenario_id"
    return table
