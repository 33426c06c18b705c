"""What is done in Rust. The modules beside this one wrap it; use those."""

from os import PathLike
from typing import Any, Dict, List, Optional, Sequence, Tuple, Union

import numpy as np
from numpy.typing import NDArray

from .types import Lights, Map, Tracks

__version__: str

class DataError(ValueError):
    """A file or message that is not what it should be; the sentence names the place."""

class Scenario:
    """Recorded traffic: past, present and future, on its map.

    Positions are box centres in the scenario's world frame, metres; headings radians
    counter-clockwise from +x. Made by `gump.open`, `gump.find`, `gump.read`, `gump.generate`.
    """

    @property
    def id(self) -> str:
        """Name, unique within its dataset."""
    @property
    def dt(self) -> float:
        """Seconds between frames."""
    @property
    def now(self) -> int:
        """Index of the present among the frames."""
    @property
    def ego(self) -> int:
        """The ego's id."""
    @property
    def targets(self) -> NDArray[np.int64]:
        """Ids of agents that a benchmark asks to predict, int64 [N], ascending."""
    @property
    def objects_of_interest(self) -> NDArray[np.int64]:
        """Ids of agents marked as interacting, int64 [N]."""
    @property
    def simulated(self) -> NDArray[np.int64]:
        """Ids of the agents that are there now, int64 [A], ascending: those that a world simulates
        and that rollouts must have, in the order of `World.simulate`."""
    @property
    def tags(self) -> List[str]:
        """What kind of situation it is, nuPlan's names; empty if not known."""
    @property
    def route(self) -> NDArray[np.int64]:
        """Ids of the lanes that the ego's route leads along; empty if none is known."""
    @property
    def tracks(self) -> Tracks:
        """All agents over time."""
    @property
    def lights(self) -> Lights:
        """Traffic lights over time."""
    @property
    def map(self) -> Map:
        """The road."""
    @property
    def future(self) -> NDArray[np.float64]:
        """What really happened to the agents of `simulated`, float64 [A, T, 4]: x, y, z, heading of
        the frames after the present, NaN where an agent is absent."""
    def __len__(self) -> int:
        """Frames, past and future."""
    def only(self, agent_id: NDArray[np.int64]) -> "Scenario":
        """The same scenario with these agents and nobody else, int64 [A]; others are no targets
        either. Raises `ValueError` if the ego is left out."""
    def save(self, path: Union[str, PathLike[str]]) -> None:
        """Writes it as a Waymo record (`.tfrecord`)."""

class Reader:
    """Iterates over the scenarios of a file or folder; see `gump.open`."""

    def __init__(self, path: Union[str, PathLike[str]]) -> None: ...
    def __iter__(self) -> "Reader": ...
    def __next__(self) -> Scenario: ...
    def __enter__(self) -> "Reader": ...
    def __exit__(self, *error: Any) -> None: ...
    def close(self) -> None:
        """Closes the file being read; `next()` raises `ValueError` from then on."""

def find(name: str) -> Scenario:
    """One scenario by name: `PATH` (the first), `PATH#INDEX` (from 0) or `PATH#SCENARIO_ID`.

    Raises `FileNotFoundError` and `DataError`.
    """

def read(message: bytes) -> Scenario: ...
def set_threads(n: int) -> None:
    """Uses so many threads from now on; 0 for one per core."""

def n_threads() -> int:
    """How many threads work is done on."""

def wosac_score(
    scenario: Scenario,
    agent_id: NDArray[np.int64],
    states: NDArray[np.float32],
    year: str,
    leave_one_out: bool,
    per_agent: bool,
    explain: bool,
    sizes: Optional[NDArray[np.float32]] = None,
    kinds: Optional[List[str]] = None,
) -> Dict[str, Any]: ...
def wosac_score_many(
    scenarios: Sequence[Scenario],
    agent_id: Sequence[NDArray[np.int64]],
    states: Sequence[NDArray[np.float32]],
    year: str,
) -> List[Dict[str, Any]]: ...
def wosac_score_catk(
    scenarios: Sequence[Scenario],
    agent_id: NDArray[np.int64],
    agent_batch: NDArray[np.int64],
    position: NDArray[np.float32],
    z: NDArray[np.float32],
    heading: NDArray[np.float32],
    year: str,
) -> List[Dict[str, Any]]: ...
def wosac_score_message(
    scenario: Scenario, message: bytes, year: str, leave_one_out: bool, per_agent: bool, explain: bool
) -> Dict[str, Any]: ...
def wosac_weights(year: str) -> Dict[str, float]: ...
def rollouts_from_message(message: bytes) -> Tuple[str, NDArray[np.int64], NDArray[np.float32]]: ...
def rollouts_from_file(
    path: Union[str, PathLike[str]],
) -> List[Tuple[str, NDArray[np.int64], NDArray[np.float32]]]: ...
def rollouts_to_message(scenario_id: str, agent_id: NDArray[np.int64], states: NDArray[np.float32]) -> bytes: ...

class Tally:
    def __init__(self) -> None: ...
    def add(
        self,
        scenario: Scenario,
        agent_id: NDArray[np.int64],
        paths: NDArray[np.float64],
        confidence: NDArray[np.float64],
        joint: bool,
    ) -> List[Dict[str, Any]]: ...
    def merge(self, other: "Tally") -> None: ...
    def rows(self) -> List[Dict[str, Any]]: ...

class World:
    def __init__(self, name: str, weights: Optional[str], sampling: Dict[str, Any]) -> None: ...
    @property
    def name(self) -> str: ...
    def simulate(
        self, scenario: Scenario, futures: int, seconds: float, seed: int, hold: bool
    ) -> NDArray[np.float64]: ...
    def start(self, scenario: Scenario, futures: int, seed: int) -> "Session": ...

class Session:
    @property
    def dt(self) -> float: ...
    @property
    def agent_id(self) -> NDArray[np.int64]: ...
    def step(self, ego: Optional[NDArray[np.float64]]) -> NDArray[np.float64]: ...
    def close(self) -> None: ...

def generate(
    world: World, traffic: World, scenario: Scenario, wish: Dict[str, Any]
) -> List[Dict[str, Any]]: ...
def nuplan_simulate(
    scenario: Scenario,
    planner: Any,
    world: World,
    imagination: Optional[World],
    seconds: float,
    perfect: bool,
    seed: int,
) -> Dict[str, Any]: ...
def nuplan_score(
    scenario: Scenario,
    time_us: NDArray[np.int64],
    ego: NDArray[np.float64],
    agent_id: Optional[NDArray[np.int64]],
    others: Optional[NDArray[np.float64]],
) -> Dict[str, Any]: ...
def nuplan_plan(
    scenario: Scenario, planner: str, imagination: Optional[World], seed: int
) -> NDArray[np.float64]: ...

class Env:
    def __init__(
        self,
        scenarios: Sequence[Scenario],
        world: World,
        num_envs: int,
        autoreset: str,
        observation: str,
        dynamics: str,
        horizon: float,
        prioritized: bool,
        nearest: Optional[int],
    ) -> None: ...
    @property
    def action_len(self) -> int: ...
    @property
    def n_scenarios(self) -> int: ...
    @property
    def observation_shape(self) -> List[int]: ...
    @property
    def dt(self) -> float: ...
    def reset(self, seeds: Optional[List[int]], mask: Optional[List[bool]]) -> NDArray[Any]: ...
    def step(
        self, actions: NDArray[np.float32]
    ) -> Tuple[NDArray[Any], NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], List[Dict[str, Any]]]: ...
    def expert_actions(self) -> NDArray[np.float32]: ...
    def close(self) -> None: ...
