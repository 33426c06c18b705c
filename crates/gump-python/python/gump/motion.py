"""Motion prediction as the Waymo challenge measures it, equal to the official numbers.

K modes of 16 positions every half second, the first half a second after the present; at most six
modes count. Horizons are 3, 5 and 8 s.
"""

from __future__ import annotations

from typing import Any, Dict, List, NamedTuple, Optional

import numpy as np

from . import _arrays, _native


class Horizon(NamedTuple):
    """What a prediction got at one horizon; `None` where nothing was recorded to compare with."""

    seconds: float
    min_ade: Optional[float]
    """Average displacement of the best mode, metres."""
    min_fde: Optional[float]
    """Displacement of the best mode at the horizon, metres."""
    missed: Optional[bool]
    """Whether no mode is what happened."""
    overlaps: bool
    """Whether the most confident mode has run into another agent by then."""


class PredictionScore(NamedTuple):
    """What one prediction got."""

    agent_id: List[int]
    kind: str
    """The kind of agent it counts for."""
    shape: Optional[str]
    """The shape of the recorded path it counts for."""
    horizons: List[Horizon]


class Row(NamedTuple):
    """A line of the table; `None` where nothing could be measured."""

    kind: Optional[str]
    """`None` is the mean over vehicles, pedestrians and bicycles."""
    seconds: Optional[float]
    """`None` is the mean over horizons."""
    predictions: int
    min_ade: Optional[float]
    min_fde: Optional[float]
    miss_rate: Optional[float]
    overlap_rate: Optional[float]
    map: Optional[float]
    """Mean average precision over shapes, 0 to 1."""
    soft_map: Optional[float]
    """The same with further matches forgiven."""


class Tally:
    """Measurements of many scenarios; tallies of several machines can be merged in any order."""

    def __init__(self) -> None:
        self._tally = _native.Tally()

    def add(
        self, scenario: _native.Scenario, agent_id: Any, paths: Any, confidence: Any, joint: bool = False
    ) -> List[PredictionScore]:
        """Measures the predictions of one scenario and keeps the measurements.

        `agent_id` [A] must be exactly `scenario.targets`, in any order; `paths` [A, K, 16, 2] are
        positions in the world frame, metres; `confidence` [A, K]. With `joint` all A agents are one
        prediction and `confidence` is [K].

        Raises `ValueError` for another shape, another set of agents, a number that is none, or a
        recording that ends before the last position; `TypeError` for arrays of no numbers.
        """
        confidence = _arrays.numbers(confidence, "confidence", np.float64)
        if joint and confidence.ndim == 1:
            confidence = confidence[None]
        values = self._tally.add(
            scenario,
            _arrays.ids(agent_id),
            _arrays.numbers(paths, "paths", np.float64),
            confidence,
            joint,
        )
        return [_prediction(one) for one in values]

    def merge(self, other: "Tally") -> None:
        """Adds the measurements of another tally."""
        self._tally.merge(other._tally)

    def rows(self) -> List[Row]:
        """The table: every kind at every horizon and over all horizons, then the means over kinds;
        the last row is what a leaderboard ranks."""
        return [Row(**row) for row in self._tally.rows()]


def score(
    scenario: _native.Scenario, agent_id: Any, paths: Any, confidence: Any, joint: bool = False
) -> List[PredictionScore]:
    """Measures the predictions of one scenario; arguments and errors are those of `Tally.add`."""
    return Tally().add(scenario, agent_id, paths, confidence, joint)


def _prediction(values: Dict[str, Any]) -> PredictionScore:
    values["horizons"] = [Horizon(**horizon) for horizon in values["horizons"]]
    return PredictionScore(**values)
