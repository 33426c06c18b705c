"""Realism and nuPlan scores, traffic worlds and driving environments.

Open recorded traffic, let a world imagine how it goes on, score that:

    import gump

    world = gump.World("model")
    for scenario in gump.open("scenarios.tfrecord"):
        states = world.simulate(scenario, futures=32)   # [R, A, T, 4]
        print(gump.wosac.score(scenario, scenario.simulated, states).metametric)

Conventions, everywhere: metres, seconds, radians counter-clockwise from +x; positions are box
centres in the scenario's world frame. In shapes R counts rollouts, A agents, T steps, and the last
axis of states is x, y, z, heading. Arrays may be NumPy's or anything with DLPack or ``__array__`` (a
CPU tensor of PyTorch, for instance); what comes back is NumPy's. Work is done without Python's lock,
on `n_threads` threads.

What cannot be done is an exception with one sentence: `FileNotFoundError`, `DataError` for damaged
files and messages, `ValueError` and `TypeError` for arguments.
"""

from typing import TYPE_CHECKING, Any

from . import motion, nuplan, planners, wosac
from ._native import DataError, Reader, Scenario, __version__, find, n_threads, set_threads
from ._reading import open, read
from .types import Area, Lane, Lights, Map, StopSign, Tracks
from .worlds import Generated, Session, Step, World, generate

if TYPE_CHECKING:
    from .vector_env import Env, VectorEnv

__all__ = [
    "Area",
    "DataError",
    "Env",
    "Generated",
    "Lane",
    "Lights",
    "Map",
    "Reader",
    "Scenario",
    "Session",
    "Step",
    "StopSign",
    "Tracks",
    "VectorEnv",
    "World",
    "__version__",
    "find",
    "generate",
    "motion",
    "n_threads",
    "nuplan",
    "open",
    "planners",
    "read",
    "set_threads",
    "wosac",
]


def __getattr__(name: str) -> Any:
    # Gymnasium takes longer to import than everything else together.
    if name in ("Env", "VectorEnv"):
        from . import vector_env

        return getattr(vector_env, name)
    raise AttributeError(f"module 'gump' has no attribute {name!r}")
