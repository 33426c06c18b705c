"""Drop-ins: official numbers through the names that people call, and what is refused."""

import sys
import types

import numpy as np
import pytest

import gump
from conftest import GOLDEN, content, document
from gump.compat import catk, pufferdrive, trajtok, waymo

TOLERANCE = 1e-6
CONFIGS = [
    "challenge_2025_sim_agents",
    "challenge_2024_config_on_2025_code",
    "challenge_2023_config_plus_tl0_on_2025_code",
    "test_config",
    "test_config_dependent_timesteps",
]


class Message:
    """A message of protobuf, as far as it is asked: it serializes, and has a text form."""

    def __init__(self, data=b"", text=""):
        self._data, self._text = data, text

    def SerializeToString(self):
        return self._data

    def __str__(self):
        return self._text


@pytest.fixture(scope="module")
def golden():
    return document(GOLDEN / "metrics_2025.json.gz")


@pytest.fixture(scope="module")
def record():
    """The message of the made-up scenario."""
    return content(GOLDEN / "scenario_syn0000000000001.tfrecord.gz")[12:-4]


@pytest.fixture(scope="module")
def noise():
    """The message of its 32 rollouts."""
    return content(GOLDEN / "rollouts_syn0000000000001_noise.binproto.gz")


@pytest.mark.parametrize("name", CONFIGS)
def test_waymos_settings_and_numbers(golden, record, noise, name):
    config = Message(text=golden["configs"][name])
    found = waymo.compute_scenario_metrics_for_bundle(config, Message(record), Message(noise))
    expected = golden["results"][found.scenario_id]["noise"][name]
    for field, value in expected["metrics"].items():
        if field != "scenario_id":
            assert getattr(found, field) == pytest.approx(value, abs=TOLERANCE, nan_ok=True), field
    buckets = waymo.aggregate_metrics_to_buckets(config, found)
    for field, value in expected["bucketed"].items():
        assert getattr(buckets, field) == pytest.approx(value, abs=TOLERANCE, nan_ok=True), field


def test_scenario_generation(golden, record):
    rollouts = content(GOLDEN / "rollouts_syn0000000000001_scenariogen4.binproto.gz")
    kind = waymo.ChallengeType.SCENARIO_GEN
    named = waymo.load_metrics_config(kind)
    stated = golden["configs"]["challenge_2025_scenario_gen"]
    for config in (named, stated):
        found = waymo.compute_scenario_metrics_for_bundle(config, record, rollouts, kind)
        expected = golden["results"][found.scenario_id]["scenariogen4"]["challenge_2025_scenario_gen"]["metrics"]
        assert found.metametric == pytest.approx(expected["metametric"], abs=TOLERANCE)


def test_their_messages_come_back_where_they_are_loaded(record, noise, monkeypatch):
    class Theirs:
        def __init__(self, **fields):
            self.__dict__.update(fields)

    protos = types.SimpleNamespace(SimAgentMetrics=Theirs, SimAgentsBucketedMetrics=Theirs)
    monkeypatch.setitem(sys.modules, "waymo_open_dataset.protos.sim_agents_metrics_pb2", protos)
    config = waymo.load_metrics_config()
    found = waymo.compute_scenario_metrics_for_bundle(config, record, noise)
    assert isinstance(found, Theirs) and found.scenario_id == "syn0000000000001"
    mean = waymo.aggregate_scenario_metrics([found, found])
    assert mean.metametric == found.metametric
    buckets = waymo.aggregate_metrics_to_buckets(config, mean)
    assert isinstance(buckets, Theirs) and buckets.realism_meta_metric == found.metametric


def test_what_waymos_functions_refuse(record, noise):
    arrays = gump.wosac.read_rollouts(noise)
    few = gump.wosac.write_rollouts(arrays.scenario_id, arrays.agent_id, arrays.states[:31])
    compute = waymo.compute_scenario_metrics_for_bundle
    with pytest.raises(ValueError, match="scenario_rollouts: expected 32 rollouts, found 31"):
        compute("2025", record, few)
    with pytest.raises(TypeError, match="scenario: expected a message or its bytes, found int"):
        compute("2025", 5, noise)
    with pytest.raises(TypeError, match="scenario_rollouts: expected a message or its bytes, found list"):
        compute("2025", record, [])
    with pytest.raises(gump.DataError):
        compute("2025", b"\xff", noise)
    with pytest.raises(gump.DataError):
        compute("2025", record, b"\x0a\xff")
    with pytest.raises(ValueError, match="challenge_type: expected SIM_AGENTS or SCENARIO_GEN, found RACE"):
        compute("2025", record, noise, "RACE")
    with pytest.raises(ValueError, match="config: expected the name of a feature, found speed"):
        compute("speed { weight: 1 }", record, noise)
    with pytest.raises(ValueError, match="config: expected an estimator of linear_speed, found none"):
        compute("linear_speed { metametric_weight: 1 }", record, noise)
    with pytest.raises(ValueError, match="config: expected a closing brace"):
        compute("linear_speed { histogram { ", record, noise)
    with pytest.raises(ValueError, match="settings: .*missing field"):
        compute("linear_speed { bernoulli { } metametric_weight: 1 }", record, noise)


@pytest.mark.parametrize("year, name", [(2024, "challenge_2024"), (2025, "challenge_2025_sim_agents")])
def test_catk(noise, year, name):
    file = GOLDEN / "scenario_syn0000000000001.tfrecord.gz"
    metrics = catk.WOSACMetrics("val", year=year)
    metrics.update([str(file), str(file)], [Message(noise), noise])
    found = metrics.compute()
    expected = document(GOLDEN / f"metrics_{year}.json.gz")["results"]["syn0000000000001"]["noise"][name]
    buckets = expected["bucketed"]
    for key in ("realism_meta_metric", "kinematic_metrics", "interactive_metrics", "map_based_metrics", "min_ade"):
        assert float(found[f"val/wosac/{key}"]) == pytest.approx(buckets[key], abs=TOLERANCE)
    assert found["val/wosac/scenario_counter"] == 2
    likelihoods = {key for key in expected["metrics"] if key != "scenario_id"}
    assert {f"val/wosac_likelihood/{key}" for key in likelihoods} <= set(found)
    for key in likelihoods:
        assert float(found[f"val/wosac_likelihood/{key}"]) == pytest.approx(expected["metrics"][key], abs=TOLERANCE)
    metrics.reset()
    with pytest.raises(ValueError, match="expected at least one scenario before compute"):
        metrics.compute()
    with pytest.raises(ValueError, match="scenario_rollouts: expected 1, one per file, found 2"):
        metrics.update([file], [noise, noise])


def test_catk_with_the_ego_alone(record, noise):
    scenario = gump.read(record)
    metrics = catk.WOSACMetrics("val", ego_only=True, year=2025)
    metrics.update([scenario], [noise])
    alone = scenario.only(np.array([scenario.ego]))
    assert alone.simulated.tolist() == [scenario.ego]
    rollouts = gump.wosac.read_rollouts(noise)
    own = rollouts.agent_id == scenario.ego
    expected = gump.wosac.score(alone, rollouts.agent_id[own], rollouts.states[:, own])
    assert metrics.compute()["val/wosac/realism_meta_metric"] == expected.metametric
    # Nobody to run into.
    assert expected.simulated_collision_rate == 0.0
    with pytest.raises(ValueError, match="expected agent_id to name the ego, .*, found it left out"):
        scenario.only(np.array([], np.int64))


def test_catks_messages(scenes):
    ids = np.concatenate([one.simulated for one in scenes])
    batch = np.concatenate([np.full(len(one.simulated), i) for i, one in enumerate(scenes)])
    states = np.random.default_rng(0).normal(size=(len(ids), 4, 80, 4)).astype(np.float32)
    codes = np.zeros((len(scenes), 64), int)
    for row, one in zip(codes, scenes):
        row[: len(one.id)] = [ord(letter) for letter in one.id]
    for names in ([one.id for one in scenes], codes):
        messages = catk.get_scenario_rollouts(names, ids, batch, states[..., :2], states[..., 2], states[..., 3])
        for i, (one, message) in enumerate(zip(scenes, messages)):
            read = gump.wosac.read_rollouts(message)
            assert read.scenario_id == one.id
            assert np.array_equal(read.agent_id, one.simulated)
            assert np.array_equal(read.states, states[batch == i].transpose(1, 0, 2, 3))
    with pytest.raises(ValueError, match=r"pred_z: expected shape"):
        catk.get_scenario_rollouts(names, ids, batch, states[..., :2], states[..., :3], states[..., 3])


def test_trajtok(record, noise, golden):
    rollouts = gump.wosac.read_rollouts(noise)
    given = {"simulated_states": rollouts.states, "agent_id": rollouts.agent_id}
    expected = golden["results"][rollouts.scenario_id]["noise"]["challenge_2025_sim_agents"]["metrics"]
    found = trajtok.compute_scenario_metrics_for_bundle(None, record, given)
    assert found.metametric == pytest.approx(expected["metametric"], abs=TOLERANCE)
    stated = Message(text=golden["configs"]["challenge_2025_sim_agents"])
    assert trajtok.compute_scenario_metrics_for_bundle(stated, gump.read(record), given).metametric == found.metametric
    metric = trajtok.WOSACMetric("2025")
    twice = np.concatenate([rollouts.states, rollouts.states], axis=1)
    n = len(rollouts.agent_id)
    metric.update(None, [record, record], np.tile(rollouts.agent_id, 2), np.repeat([0, 1], n), twice)
    assert metric.compute()["metametric"] == found.metametric
    assert "traffic_light_violation_likelihood" not in trajtok.WOSACMetric("2024")._running.names
    with pytest.raises(ValueError, match="simulated_states: expected shape"):
        metric.update(None, [record], rollouts.agent_id, np.zeros(n, int), twice)
    with pytest.raises(KeyError, match="agent_id"):
        trajtok.compute_scenario_metrics_for_bundle(None, record, {"simulated_states": rollouts.states})


@pytest.fixture(scope="module")
def puffer(scenes):
    """Two scenes as PufferDrive hands them over, their rollouts, and the scores of the scenes as they are."""
    rng, rollouts = np.random.default_rng(0), 6
    truth, simulated, state, edges, expected = {}, {}, {}, {}, {}

    def add(into, **columns):
        for name, column in columns.items():
            into.setdefault(name, []).append(np.asarray(column))

    for scene in (scenes[0], scenes[2]):
        tracks, agents = scene.tracks, scene.simulated
        rows = np.searchsorted(tracks.agent_id, agents)
        log, heading = np.nan_to_num(tracks.position[rows]), np.nan_to_num(tracks.heading[rows])
        states = np.zeros((rollouts, len(rows), 80, 4), np.float32)
        states[..., :2] = log[:, scene.now, None, :2] + np.cumsum(rng.normal(0, 0.3, (*states.shape[:3], 2)), axis=2)
        states[..., 2], states[..., 3] = log[:, scene.now, 2, None], heading[:, scene.now, None]
        ids = np.where(np.isin(agents, [*scene.targets, scene.ego]), agents, -1)
        told = np.concatenate([np.zeros((len(rows), rollouts, 11, 4)), states.transpose(1, 0, 2, 3)], axis=2)
        names = np.full((len(rows), 1), scene.id)
        valid = tracks.valid[rows][:, None]
        add(truth, x=log[:, None, :, 0], y=log[:, None, :, 1], heading=heading[:, None], valid=valid)
        add(truth, id=ids[:, None], scenario_id=names)
        add(simulated, x=told[..., 0], y=told[..., 1], heading=told[..., 3])
        add(simulated, id=np.broadcast_to(ids[:, None, None], told.shape[:3]))
        size = tracks.size[rows, scene.now]
        add(state, length=size[:, 0], width=size[:, 1], kind=[tracks.kind[row] for row in rows])
        lines = scene.map.road_edges
        add(edges, x=np.concatenate(lines)[:, 0], y=np.concatenate(lines)[:, 1])
        add(edges, lengths=[len(line) for line in lines], scenario_id=[scene.id] * len(lines))
        expected[scene.id] = gump.wosac.score(scene, agents, states, 2024)
    given = [{name: np.concatenate(column) for name, column in one.items()} for one in (truth, simulated, state, edges)]
    return given, expected


def rows_of(table):
    return table.to_dict("index") if hasattr(table, "to_dict") else table


def test_pufferdrive(puffer):
    given, expected = puffer
    found = rows_of(pufferdrive.WOSACEvaluator({}).compute_metrics(*given))
    assert list(found) == list(expected)
    # What heights do not enter is the same.
    same = ("angular_speed", "angular_acceleration", "distance_to_nearest_object", "time_to_collision", "collision_indication")
    for name, scores in expected.items():
        for part in same:
            assert found[name][f"likelihood_{part}"] == getattr(scores, f"{part}_likelihood"), part
        assert found[name]["realism_meta_score"] == pytest.approx(scores.metametric, abs=0.01)
        assert found[name]["num_collisions_sim"] == pytest.approx(6 * scores.simulated_collision_rate)
    means = pufferdrive.WOSACEvaluator().compute_metrics(*given, aggregate_results=True)
    assert means["realism_meta_score"] == pytest.approx(np.mean([row["realism_meta_score"] for row in found.values()]))
    assert means["total_num_agents"] == sum(row["num_agents"] for row in found.values())


def test_pufferdrive_from_the_present_on(puffer):
    given, expected = puffer
    later = [{name: a[..., 10:] if a.ndim == 3 else a for name, a in one.items()} for one in given]
    found = rows_of(pufferdrive.WOSACEvaluator().compute_metrics(*later))
    for name, scores in expected.items():
        assert found[name]["realism_meta_score"] == pytest.approx(scores.metametric, abs=0.02)


def test_what_pufferdrives_function_refuses(puffer):
    (truth, simulated, state, edges), _ = puffer
    compute = pufferdrive.WOSACEvaluator().compute_metrics
    with pytest.raises(ValueError, match=r"x: expected an array of shape \[A, R, 81\] or \[A, R, 91\], found"):
        compute(truth, {**simulated, "x": simulated["x"][..., :50]}, state, edges)
    with pytest.raises(ValueError, match="y: expected a log of shape"):
        compute({**truth, "y": truth["y"][:, 0]}, simulated, state, edges)
    with pytest.raises(ValueError, match="id: expected .* for agent 0 as in the log, found"):
        compute(truth, {**simulated, "id": simulated["id"] + 1}, state, edges)
    with pytest.raises(ValueError, match="road_edge_polylines: expected"):
        compute(truth, simulated, state, {**edges, "x": edges["x"][1:]})
    with pytest.raises(ValueError, match="expected an agent with an id of 0 or more at the present, found none"):
        nobody = {"id": np.full_like(truth["id"], -1)}
        compute({**truth, **nobody}, {**simulated, "id": np.full_like(simulated["id"], -1)}, state, edges)
    with pytest.raises(ValueError, match="kind: expected vehicle, pedestrian, bicycle or other, found tram"):
        compute(truth, simulated, {**state, "kind": ["tram"] * len(state["length"])}, edges)
    with pytest.raises(KeyError, match="lengths"):
        compute(truth, simulated, state, {})
