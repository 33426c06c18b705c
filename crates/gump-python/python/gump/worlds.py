"""Worlds that imagine how traffic goes on, and scenes made from nothing."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any, List, NamedTuple, Optional, Sequence, Tuple, Union

import numpy as np

from . import _arrays, _native

_WEIGHTS = Path(__file__).with_name("weights")
SHIPPED_WEIGHTS = _WEIGHTS / "gump-relative.safetensors"
"""The weights of traffic that come with the package: the network with relative attention."""
GENERATOR_WEIGHTS = _WEIGHTS / "gump-tiny.safetensors"
"""The weights that make scenes from nothing: the sequence network."""


class World:
    """A world: imagines how traffic goes on, many futures at once.

    `name` is "idm" (rule-driven traffic that reacts), "constant-velocity", "log" (what really
    happened: an oracle), "model" (the network that comes with the package) or "model:WEIGHTS", a
    file of weights of either architecture.

    How a network draws: `temperature` divides the logits, `top_k` bins may be drawn per field, and
    among them the likeliest that together have the probability `top_p`; `decay` weighs earlier
    predictions of a moment, `redraws` is how often what would run into something or off the road is
    drawn again, `limits` hold back what cannot move so. `raw` is the network alone, `paper` the
    paper's decoding, `spawn` lets agents come and leave, as many as at the start. `lights` is what
    traffic lights show: "model", what signals of such junctions do, or "hold". `routes` is when
    vehicles of the relative network are given routes, which they keep: "never", "late" (after nine
    seconds) or "always". `mode` is "partial-ar" or "full-ar", `precision` "f32", "bf16" or "int8".

    Raises `ValueError` for another name or a number out of its range, `FileNotFoundError` and
    `DataError` for weights.
    """

    def __init__(
        self,
        name: str = "model",
        *,
        temperature: Optional[float] = None,
        top_k: Optional[int] = None,
        top_p: Optional[float] = None,
        decay: Optional[float] = None,
        redraws: Optional[int] = None,
        limits: bool = True,
        raw: bool = False,
        paper: bool = False,
        spawn: bool = False,
        lights: str = "model",
        routes: str = "late",
        mode: str = "partial-ar",
        precision: str = "f32",
        life: Optional[bool] = None,
    ) -> None:
        if not isinstance(name, str):
            raise TypeError(f"world: expected a name, found {type(name).__name__}")
        if life is not None:
            warnings.warn(
                "life is now spawn; the former name works until 0.3", DeprecationWarning, stacklevel=2
            )
            spawn = spawn or life
        weights = None
        if name == "model":
            weights = os.fspath(SHIPPED_WEIGHTS)
        elif name.startswith("model:") and len(name) > len("model:"):
            weights = name[len("model:") :]
        sampling = {
            "mode": mode,
            "temperature": temperature,
            "top_k": top_k,
            "top_p": top_p,
            "decay": decay,
            "redraws": redraws,
            "limits": limits,
            "raw": raw,
            "paper": paper,
            "spawn": spawn,
            "lights": lights,
            "routes": routes,
            "precision": precision,
        }
        self._world = _native.World(name, weights, sampling)

    @property
    def name(self) -> str:
        """As it was asked for."""
        return self._world.name

    def simulate(
        self,
        scenario: _native.Scenario,
        futures: int = 32,
        seconds: float = 8.0,
        seed: int = 0,
        hold: bool = True,
    ) -> np.ndarray:
        """Imagines what comes after the present; the world drives the ego, too, and is not given its
        route.

        Gives float64 [R, A, T, 4] in steps of `scenario.dt`: x, y, z, heading of the agents of
        `scenario.simulated`. An agent that the world removes stays where it was last, as challenges
        have it; with `hold=False` it is NaN. The same seed gives the same futures, future r whatever
        `futures` is.

        Raises `ValueError` for numbers out of range and for a scenario that the world cannot
        imagine, a map without lanes for instance.
        """
        return self._world.simulate(_scenario(scenario), futures, seconds, seed, hold)

    def start(self, scenario: _native.Scenario, futures: int = 1, seed: int = 0) -> "Session":
        """Opens futures that go on step by step, the ego driven by you if you like.

        Raises as `simulate`.
        """
        return Session(self._world.start(_scenario(scenario), futures, seed))

    def __repr__(self) -> str:
        return f"gump.World({self.name!r})"


class Step(NamedTuple):
    """A frame of all futures."""

    states: np.ndarray
    """float64 [R, A, 4]: x, y, z, heading; NaN where an agent is absent."""
    velocity: np.ndarray
    """float64 [R, A, 2]: metres per second, world frame."""


class Session:
    """Futures in progress. A context manager; `close` lets them go."""

    def __init__(self, session: Any) -> None:
        self._session = session

    @property
    def dt(self) -> float:
        """Seconds that a step takes: 0.5 for networks, the scenario's own for rules."""
        return self._session.dt

    @property
    def agent_id(self) -> np.ndarray:
        """int64 [A]: the agents of the states, those that are there at the start."""
        return self._session.agent_id

    def step(self, ego: Any = None) -> Step:
        """Imagines the next frame of every future.

        `ego` [R, 5] is where the ego is at the end of the step: x, y, heading (box centre), and
        velocity x, y; the others react to it within the step. Without it the world drives the ego.

        Raises `ValueError` for another shape, a number that is none, a world that cannot go on or a
        session that was closed.
        """
        found = self._session.step(_arrays.optional(ego, "ego", np.float64))
        return Step(found[..., :4], found[..., 4:])

    def close(self) -> None:
        """Lets the futures go."""
        self._session.close()

    def __enter__(self) -> "Session":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


class Generated(NamedTuple):
    """A scene that was made."""

    scenario: _native.Scenario
    """The scene at its present, with what was imagined of its future."""
    holds: bool
    """Whether no clause fails."""
    clauses: List[Tuple[str, Optional[bool]]]
    """What was asked for, in words, and whether it holds; `None` if that cannot be decided."""
    attempts: int
    """Scenes made until this one."""
    is_steered: bool
    """Whether the ego was driven as the prompts say, rather than by the world."""


def generate(
    scenario: _native.Scenario,
    prompt: Union[str, Sequence[str]] = (),
    *,
    vehicles: Optional[int] = None,
    pedestrians: Optional[int] = None,
    bicycles: Optional[int] = None,
    objects: Optional[str] = None,
    count: int = 1,
    seconds: float = 0.0,
    anywhere: bool = False,
    guided: bool = True,
    attempts: int = 20,
    seed: int = 0,
    world: Optional[World] = None,
    traffic: Optional[World] = None,
) -> List[Generated]:
    """Makes `count` scenes on the map of a scenario.

    `prompt` are up to four of nuPlan's scenario tags. `vehicles` (besides the ego), `pedestrians` and
    `bicycles` say how many; with none given the network decides. `objects` are wishes for single
    objects as TOML text. `seconds` of every scene's future are simulated. `anywhere` lets the ego start
    on any lane around there; `guided` puts objects on lanes and walkways only.

    Raises `ValueError` for an unknown tag, contradicting wishes, numbers out of range and worlds that
    cannot do this, `RuntimeError` if a scene cannot be made.

    `world` is a sequence network, the only kind that makes scenes; by default the one that comes with
    the package. `traffic` simulates the seconds that follow, and the moments at which prompts are
    checked; by default the relative network that comes with the package. Any world but "log" will do.
    """
    wish = {
        "prompts": [prompt] if isinstance(prompt, str) else list(prompt),
        "vehicles": vehicles,
        "pedestrians": pedestrians,
        "bicycles": bicycles,
        "objects": objects,
        "count": count,
        "seconds": seconds,
        "anywhere": anywhere,
        "guided": guided,
        "attempts": attempts,
        "seed": seed,
    }
    world = World(f"model:{GENERATOR_WEIGHTS}") if world is None else world
    traffic = World() if traffic is None else traffic
    made = _native.generate(world._world, traffic._world, _scenario(scenario), wish)
    return [Generated(**one) for one in made]


def _scenario(value: Any) -> _native.Scenario:
    if not isinstance(value, _native.Scenario):
        raise TypeError(f"scenario: expected a gump.Scenario, found {type(value).__name__}")
    return value
