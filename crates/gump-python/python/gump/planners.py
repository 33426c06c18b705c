"""Planners of ours, to be given to `gump.nuplan.simulate` or asked for a plan."""

from __future__ import annotations

from typing import Optional

import numpy as np

from . import _native
from .worlds import World, _scenario


class _Planner:
    _gump_planner = ""

    def __init__(self, imagination: Optional[World] = None) -> None:
        self.imagination = imagination

    def plan(self, scenario: _native.Scenario, seed: int = 0) -> np.ndarray:
        """What it would drive at the scenario's present: float64 [N, 12], seconds from now and the
        columns of `gump.nuplan.EGO_FIELDS`.

        Raises `ValueError` for a scenario that cannot be driven through.
        """
        imagination = None if self.imagination is None else self.imagination._world
        return _native.nuplan_plan(_scenario(scenario), self._gump_planner, imagination, seed)

    def __repr__(self) -> str:
        return f"gump.planners.{type(self).__name__}()"


class PdmClosed(_Planner):
    """PDM-Closed: 15 proposals of an IDM along the route, each judged against a forecast."""

    _gump_planner = "pdm-closed"

    def __init__(self) -> None:
        super().__init__()


class Idm(_Planner):
    """nuPlan's IDM planner: the route at the speed limit, following the leader."""

    _gump_planner = "idm"

    def __init__(self) -> None:
        super().__init__()


class Imitation(_Planner):
    """Drives as the world it imagines in has the ego drive: the mean of several futures."""

    _gump_planner = "imitation"


class Interactive(_Planner):
    """19 policies, lane changes and imitation, each rolled out among reactive agents."""

    _gump_planner = "interactive"
