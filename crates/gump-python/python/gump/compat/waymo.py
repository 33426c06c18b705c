"""In place of `waymo_open_dataset.wdl_limited.sim_agents_metrics.metrics`.

    from gump.compat import waymo as metrics
    config = metrics.load_metrics_config()
    found = metrics.compute_scenario_metrics_for_bundle(config, scenario, scenario_rollouts)

Scenarios and rollouts are messages of the real package, their serialized bytes, or a `gump.Scenario`.
Where `waymo_open_dataset` is loaded, its own `SimAgentMetrics` and `SimAgentsBucketedMetrics` come
back, otherwise `gump.wosac.Scores` and `Buckets`, which have the same fields.
"""

from __future__ import annotations

import enum
import sys
from typing import Any, Dict, List, Optional, Tuple, Union

from .. import _native, _reading, wosac

N_ROLLOUTS = 32
"""Rollouts that the challenge asks for."""


class ChallengeType(enum.Enum):
    """Which challenge of 2025."""

    SIM_AGENTS = 1
    SCENARIO_GEN = 2


_YEARS = {ChallengeType.SIM_AGENTS: "2025", ChallengeType.SCENARIO_GEN: "2025-generation"}


def load_metrics_config(challenge_type: Any = ChallengeType.SIM_AGENTS) -> str:
    """The settings of a challenge of 2025, by their name here."""
    return _YEARS[_challenge(challenge_type)]


def compute_scenario_metrics_for_bundle(
    config: Any,
    scenario: Any,
    scenario_rollouts: Any,
    challenge_type: Any = ChallengeType.SIM_AGENTS,
) -> Any:
    """Scores the 32 rollouts of a scenario.

    `config` is a year ("2024"), a message `SimAgentMetricsConfig`, its text, or `gump.wosac.Settings`; as in
    the package of 2025, a message's settings are applied to features as of 2025.

    Raises `ValueError` for rollouts that do not fit the scenario or are not 32 (of `SIM_AGENTS`), and
    `gump.DataError` for what is no message.
    """
    challenge = _challenge(challenge_type)
    message = _bytes(scenario_rollouts, "scenario_rollouts")
    if challenge is ChallengeType.SIM_AGENTS:
        n = len(_fields(message, 2))
        if n != N_ROLLOUTS:
            raise ValueError(f"scenario_rollouts: expected {N_ROLLOUTS} rollouts, found {n}")
    scores = wosac.score_message(_scenario(scenario), message, _settings(config, challenge))
    return _message("SimAgentMetrics", scores, _METRIC_FIELDS)


def aggregate_scenario_metrics(all_scenario_metrics: List[Any]) -> Any:
    """The mean over scenarios."""
    mean = wosac.mean([_scores(one) for one in all_scenario_metrics])
    return _message("SimAgentMetrics", mean, _METRIC_FIELDS)


def aggregate_metrics_to_buckets(config: Any, metrics: Any) -> Any:
    """The meta metric and its groups of one scenario's metrics, or of a mean."""
    scores = _scores(metrics)
    settings = _settings(config, ChallengeType.SIM_AGENTS)
    weights = {name: weight for name, weight in wosac.weights(settings).items()}

    def group(names: Tuple[str, ...]) -> float:
        parts = [(weights[name], getattr(scores, name)) for name in names if name in weights]
        return sum(weight * value for weight, value in parts) / sum(weight for weight, _ in parts)

    buckets = wosac.Buckets(
        scores.metametric,
        group(_KINEMATIC),
        group(_INTERACTIVE),
        group(_MAP_BASED),
        scores.min_average_displacement_error,
        scores.simulated_collision_rate,
        scores.simulated_offroad_rate,
        scores.simulated_traffic_light_violation_rate,
    )
    return _message("SimAgentsBucketedMetrics", buckets, wosac.Buckets.__dataclass_fields__)


_KINEMATIC = (
    "linear_speed_likelihood",
    "linear_acceleration_likelihood",
    "angular_speed_likelihood",
    "angular_acceleration_likelihood",
)
_INTERACTIVE = (
    "distance_to_nearest_object_likelihood",
    "collision_indication_likelihood",
    "time_to_collision_likelihood",
)
_MAP_BASED = (
    "distance_to_road_edge_likelihood",
    "offroad_indication_likelihood",
    "traffic_light_violation_likelihood",
)
_METRIC_FIELDS = (
    "scenario_id",
    "metametric",
    "average_displacement_error",
    "min_average_displacement_error",
    *_KINEMATIC,
    *_INTERACTIVE,
    *_MAP_BASED,
    "simulated_collision_rate",
    "simulated_offroad_rate",
    "simulated_traffic_light_violation_rate",
)


def _challenge(value: Any) -> ChallengeType:
    """Ours of theirs, which has the same names."""
    name = getattr(value, "name", value)
    try:
        return ChallengeType[name]
    except KeyError:
        raise ValueError(f"challenge_type: expected SIM_AGENTS or SCENARIO_GEN, found {name}") from None


def _bytes(value: Any, name: str) -> bytes:
    """A message of the real package, or its bytes."""
    if isinstance(value, (bytes, bytearray, memoryview)):
        return bytes(value)
    serialize = getattr(value, "SerializeToString", None)
    if not callable(serialize):
        raise TypeError(f"{name}: expected a message or its bytes, found {type(value).__name__}")
    return serialize()


def _scenario(value: Any) -> _native.Scenario:
    if isinstance(value, _native.Scenario):
        return value
    return _reading.read(_bytes(value, "scenario"))


def _scores(metrics: Any) -> wosac.Scores:
    """Scores of a message of the real package, whose groups are not known."""
    if isinstance(metrics, wosac.Scores):
        return metrics
    nan = float("nan")
    fields = {name: getattr(metrics, name) for name in _METRIC_FIELDS}
    return wosac.Scores(kinematic_metrics=nan, interactive_metrics=nan, map_based_metrics=nan, **fields)


def _message(name: str, found: Any, fields: Any) -> Any:
    """A message of the real package if that is loaded, else what was found."""
    protos = sys.modules.get("waymo_open_dataset.protos.sim_agents_metrics_pb2")
    if protos is None:
        return found
    values = {field: getattr(found, field) for field in fields}
    return getattr(protos, name)(**{field: value for field, value in values.items() if value is not None})


def _fields(message: bytes, wanted: int) -> List[bytes]:
    """The values of a field that holds messages."""
    at, found = 0, []

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            if at >= len(message):
                raise _native.DataError("expected a message, found bytes that end inside a number")
            byte = message[at]
            value |= (byte & 127) << shift
            at, shift = at + 1, shift + 7
            if byte < 128:
                return value

    while at < len(message):
        key = varint()
        if key & 7 == 0:
            varint()
            continue
        length = varint() if key & 7 == 2 else {5: 4, 1: 8}.get(key & 7, 0)
        if key >> 3 == wanted:
            found.append(message[at : at + length])
        at += length
    return found


def _settings(config: Any, challenge: ChallengeType) -> wosac.Year:
    """What a year, a message or its text says."""
    if isinstance(config, (int, wosac.Settings)) or str(config) in wosac.YEARS:
        return config
    return wosac.Settings(_toml(_parse(str(config)), challenge))


def _parse(text: str) -> Dict[str, Any]:
    """A message in protobuf's text form: names with numbers, or with more in braces."""
    words = iter(text.replace("{", " { ").replace("}", " } ").replace(":", " ").split())

    def block(is_inner: bool) -> Dict[str, Any]:
        found: Dict[str, Any] = {}
        for name in words:
            if name == "}":
                return found
            value: Any = next(words, None)
            if value is None or value == "}":
                raise ValueError(f"config: expected a value of {name}, found none")
            found[name] = block(True) if value == "{" else value
        if is_inner:
            raise ValueError("config: expected a closing brace, found the end of the text")
        return found

    return block(False)


_COMPONENTS = {
    "linear_speed": "linear_speed",
    "linear_acceleration": "linear_acceleration",
    "angular_speed": "angular_speed",
    "angular_acceleration": "angular_acceleration",
    "distance_to_nearest_object": "distance_to_nearest_object",
    "collision_indication": "collision",
    "time_to_collision": "time_to_collision",
    "distance_to_road_edge": "distance_to_road_edge",
    "offroad_indication": "offroad",
    "traffic_light_violation": "traffic_light_violation",
}


def _toml(config: Dict[str, Any], challenge: ChallengeType) -> str:
    mode = "generation" if challenge is ChallengeType.SCENARIO_GEN else "sim-agents"
    lines = ['algorithm = "2025"', f'mode = "{mode}"']
    for name, feature in config.items():
        if name not in _COMPONENTS:
            raise ValueError(f"config: expected the name of a feature, found {name}")
        lines += [f"[{_COMPONENTS[name]}]", f"weight = {float(feature.get('metametric_weight', 0.0))}"]
        for ours, theirs in (("independent_timesteps", "independent_timesteps"), ("aggregate_agents", "aggregate_objects")):
            lines.append(f"{ours} = {feature.get(theirs, 'false')}")
        lines.append(f"estimator = {_estimator(name, feature)}")
    return "\n".join(lines)


def _estimator(name: str, feature: Dict[str, Any]) -> str:
    def number(settings: Dict[str, Any], key: str, default: Optional[float] = None) -> float:
        if key not in settings and default is None:
            raise ValueError(f"config: expected {key} of {name}, found none")
        return float(settings.get(key, default))

    if "histogram" in feature:
        histogram: Dict[str, Any] = feature["histogram"]
        ends = f"min = {number(histogram, 'min_val')}, max = {number(histogram, 'max_val')}"
        bins = f"bins = {int(number(histogram, 'num_bins'))}"
        smoothing = number(histogram, "additive_smoothing_pseudocount", 0.001)
        return f"{{ histogram = {{ {ends}, {bins}, pseudocount = {smoothing} }} }}"
    if "bernoulli" in feature:
        smoothing = number(feature["bernoulli"], "additive_smoothing_pseudocount", 0.001)
        return f"{{ bernoulli = {{ pseudocount = {smoothing} }} }}"
    if "kernel_density" in feature:
        return f"{{ kernel_density = {{ bandwidth = {number(feature['kernel_density'], 'bandwidth')} }} }}"
    raise ValueError(f"config: expected an estimator of {name}, found none")
