"""Realism: official numbers, Rust's numbers, layouts, threads, and what is refused."""

import dataclasses
import json
import os
import subprocess
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import gump
from conftest import GOLDEN, MINI, REPOSITORY, content, document, shared

SETTINGS = {"2023-v0": "2023", "2023": "2023", "2024": "2024", "2025": "2025_sim_agents"}
FILES = {"2023-v0": "2023v0", "2023": "2023v1", "2024": "2024", "2025": "2025"}
TOLERANCE = 1e-6


def check(scores, expected):
    for name, value in expected["metrics"].items():
        if name != "scenario_id":
            assert getattr(scores, name) == pytest.approx(value, abs=TOLERANCE), name
    for name, value in expected["bucketed"].items():
        assert getattr(scores.buckets, name) == pytest.approx(value, abs=TOLERANCE), name


def stacked(messages):
    """Rollouts of several messages of one scenario as one array."""
    parts = [gump.wosac.read_rollouts(message) for message in messages]
    first = parts[0]
    order = [np.argsort(part.agent_id) for part in parts]
    states = np.concatenate([part.states[:, rows] for part, rows in zip(parts, order)])
    return np.sort(first.agent_id), states


@pytest.fixture(scope="module")
def synthetic():
    """A made-up scenario with its rollouts in two sets, and official numbers by year."""
    (scenario,) = gump.open(GOLDEN / "scenario_syn0000000000001.tfrecord.gz")
    noise = stacked([content(GOLDEN / "rollouts_syn0000000000001_noise.binproto.gz")])
    agent_id, states = stacked([content(GOLDEN / "rollouts_syn0000000000001_cv_1scene.binproto.gz")])
    return scenario, {"noise": noise, "cv": (agent_id, np.repeat(states, 32, axis=0))}


def golden_of(scenario_id, year):
    if scenario_id.startswith("syn"):
        path = GOLDEN / f"metrics_{FILES[year]}.json.gz"
    else:
        path = shared(f"golden/wosac/metrics_{FILES[year]}.json")
    sets = document(path)["results"][scenario_id]
    return {name: found[f"challenge_{SETTINGS[year]}"] for name, found in sets.items() if "gen" not in name}


@pytest.mark.parametrize("year", SETTINGS)
@pytest.mark.parametrize("which", ["noise", "cv"])
def test_official_numbers_of_a_made_up_scenario(synthetic, year, which):
    scenario, rollouts = synthetic
    scores = gump.wosac.score(scenario, *rollouts[which], year=year)
    check(scores, golden_of(scenario.id, year)[which])


@pytest.mark.parametrize("year", SETTINGS)
def test_official_numbers_of_a_recorded_scenario(year):
    (scenario,) = gump.open(shared("data/waymo/scenario_a.tfrecord"))
    golden = golden_of(scenario.id, year)
    inputs = shared("golden/wosac/inputs")
    parts = [f"rollouts_{scenario.id}_noise_part{i}.binproto" for i in (0, 1)]
    noise = stacked([content(inputs / part) for part in parts])
    check(gump.wosac.score(scenario, *noise, year=year), golden["noise"])
    agent_id, states = stacked([content(inputs / f"rollouts_{scenario.id}_cv_1scene.binproto")])
    check(gump.wosac.score(scenario, agent_id, np.repeat(states, 32, axis=0), year=year), golden["cv"])


def test_messages_score_as_their_arrays(synthetic):
    scenario, rollouts = synthetic
    message = content(GOLDEN / "rollouts_syn0000000000001_noise.binproto.gz")
    assert gump.wosac.score_message(scenario, message) == gump.wosac.score(scenario, *rollouts["noise"])
    written = gump.wosac.write_rollouts(scenario.id, *rollouts["noise"])
    read = gump.wosac.read_rollouts(written)
    assert read.scenario_id == scenario.id
    assert np.array_equal(read.states, rollouts["noise"][1])


def test_scenario_generation(synthetic):
    scenario, _ = synthetic
    scores = gump.wosac.score_message(
        scenario, content(GOLDEN / "rollouts_syn0000000000001_scenariogen4.binproto.gz"), "2025-generation"
    )
    golden = document(GOLDEN / "metrics_2025.json.gz")["results"][scenario.id]["scenariogen4"]
    expected = golden["challenge_2025_scenario_gen"]["metrics"]
    assert scores.metametric == pytest.approx(expected["metametric"], abs=TOLERANCE)
    tracks = scenario.tracks
    now = tracks.valid[:, scenario.now]
    states = np.concatenate([tracks.position, tracks.heading[..., None]], axis=2)[now]
    states, sizes = np.nan_to_num(states)[None], np.nan_to_num(tracks.size[now], nan=1.0)[None]
    kinds = [kind for kind, there in zip(tracks.kind, now) if there]
    agent_id = tracks.agent_id[now]
    scores = gump.wosac.score(scenario, agent_id, states, "2025-generation", sizes=sizes, kinds=kinds)
    assert 0.0 < scores.metametric < 1.0
    with pytest.raises(ValueError, match="sizes, kinds: expected both"):
        gump.wosac.score(scenario, agent_id, states, "2025-generation")


def test_the_command_line_has_the_same_bits(tmp_path):
    """`evaluate wosac` on the same rollouts, bit for bit; GUMP_XTASK names the built driver."""
    xtask = os.environ.get("GUMP_XTASK")
    if not xtask:
        pytest.skip("GUMP_XTASK does not name a built driver")
    scenes = MINI / "procedural.tfrecord.gz"
    command = [xtask, "evaluate", "wosac", "--scenarios", str(scenes), "--world", "constant-velocity"]
    command += ["--shard", "1/12", "--quiet", "--out", str(tmp_path)]
    subprocess.run(command, cwd=REPOSITORY, check=True, timeout=600)
    (row,) = json.loads((tmp_path / "report.json").read_text())["results"]["rows"][:1]
    world = gump.World("constant-velocity")
    each = []
    for i, scenario in enumerate(gump.open(scenes)):
        if i % 12 == 0:
            states = world.simulate(scenario, futures=32)
            each.append(gump.wosac.score(scenario, scenario.simulated, states))
    assert row["scenarios"] == len(each)
    mean = gump.wosac.mean(each)
    assert row["metametric"] == mean.metametric
    assert row["kinematic"] == mean.kinematic_metrics
    assert row["interactive"] == mean.interactive_metrics
    assert row["map_based"] == mean.map_based_metrics
    assert row["components"]["linear_speed"] == mean.linear_speed_likelihood
    assert row["components"]["offroad"] == mean.offroad_indication_likelihood


def moved(scenario, n, seed=0):
    """Rollouts near what really happened."""
    truth = scenario.future
    last = np.where(np.isnan(truth), np.nanmean(truth, axis=1, keepdims=True), truth)
    noise = np.random.default_rng(seed).normal(0.0, 0.3, (n, *truth.shape))
    return np.nan_to_num(last + noise * [1.0, 1.0, 0.0, 0.05])


def test_layouts_agree(scenes):
    ids = [scenario.simulated for scenario in scenes]
    states = [moved(scenario, 6, i).astype(np.float32) for i, scenario in enumerate(scenes)]
    alone = [gump.wosac.score(*one) for one in zip(scenes, ids, states)]
    assert gump.wosac.score_many(scenes, ids, states) == alone
    batch = np.concatenate([np.full(len(one), i) for i, one in enumerate(ids)])
    together = np.concatenate([one.transpose(1, 0, 2, 3) for one in states])
    shuffled = np.random.default_rng(0).permutation(len(batch))
    together, agent_id, batch = together[shuffled], np.concatenate(ids)[shuffled], batch[shuffled]
    catk = gump.wosac.score_batch(
        scenes, agent_id, batch, together[..., :2], together[..., 2], together[..., 3]
    )
    assert catk == alone
    mean = gump.wosac.mean(alone)
    assert mean.metametric == pytest.approx(np.mean([one.metametric for one in alone]), abs=1e-12)


def test_order_and_threads_change_nothing(crossing):
    states = moved(crossing, 4)
    expected = gump.wosac.score(crossing, crossing.simulated, states)
    backwards = gump.wosac.score(crossing, crossing.simulated[::-1], states[:, ::-1])
    assert backwards == expected
    n = gump.n_threads()
    try:
        gump.set_threads(1)
        assert gump.n_threads() == 1
        assert gump.wosac.score(crossing, crossing.simulated, states) == expected
    finally:
        gump.set_threads(n)
    with ThreadPoolExecutor(4) as pool:
        futures = [pool.submit(gump.wosac.score, crossing, crossing.simulated, states) for _ in range(8)]
        assert all(future.result() == expected for future in futures)


def test_leave_one_out_is_the_score_of_the_others(crossing):
    states = moved(crossing, 4)
    states[2] += 3.0
    scores = gump.wosac.score(crossing, crossing.simulated, states, leave_one_out=True)
    for r in range(4):
        others = gump.wosac.score(crossing, crossing.simulated, np.delete(states, r, axis=0))
        assert scores.leave_one_out[r] == others.metametric
    assert np.argmin(scores.rewards) == 2
    assert abs(scores.rewards.sum()) < 1e-12
    with pytest.raises(ValueError, match="leave_one_out: expected at least 2 rollouts, found 1"):
        gump.wosac.score(crossing, crossing.simulated, states[:1], leave_one_out=True)


def test_agents_and_explanations(crossing):
    scores = gump.wosac.score(crossing, crossing.simulated, moved(crossing, 8), per_agent=True, explain=True)
    agents = scores.per_agent
    assert agents.steps.shape == (len(agents.agent_id), 80)
    assert set(agents.agent_id) == {crossing.ego, *crossing.targets}
    assert ((agents.realism > 0) & (agents.realism <= 1)).all()
    costs = [attribution.cost for attribution in scores.explanation]
    assert costs == sorted(costs, reverse=True)
    assert sum(costs) == pytest.approx(1.0 - scores.metametric, abs=1e-6)


def test_weights_add_up():
    assert sum(gump.wosac.weights(2025).values()) == pytest.approx(1.0, abs=1e-6)
    assert "traffic_light_violation_likelihood" not in gump.wosac.weights(2024)


class Tensor:
    """An array of another library: DLPack and nothing else."""

    def __init__(self, array):
        self._array = array

    def __dlpack__(self, **keywords):
        return self._array.__dlpack__(**keywords)

    def __dlpack_device__(self):
        return self._array.__dlpack_device__()


class Remote(Tensor):
    """An array in the memory of another device."""

    def __dlpack__(self, **keywords):
        raise BufferError("the memory of another device")


def test_anything_with_dlpack_will_do(crossing):
    states = moved(crossing, 4).astype(np.float32)
    expected = gump.wosac.score(crossing, crossing.simulated, states)
    found = gump.wosac.score(crossing, Tensor(crossing.simulated), Tensor(states))
    assert found == expected
    assert gump.wosac.score(crossing, crossing.simulated.tolist(), states.tolist()) == expected
    with pytest.raises(TypeError, match="states: expected an array in main memory"):
        gump.wosac.score(crossing, crossing.simulated, Remote(states))


def test_a_child_process_scores_too(crossing):
    """Data loaders fork; a pool of threads does not survive that."""
    states = moved(crossing, 4)
    expected = gump.wosac.score(crossing, crossing.simulated, states).metametric
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            found = gump.wosac.score(crossing, crossing.simulated, states).metametric
            os.write(write, repr(found).encode())
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        assert float(pipe.read()) == expected
    os.waitpid(child, 0)


BAD = [
    ("an axis is missing", ValueError, r"states: expected an array of shape \[R, A, T, 4\]", lambda a, s: (a, s[0])),
    ("too few steps", ValueError, r"states: expected 80 along axis 2 .*, found 79", lambda a, s: (a, s[:, :, :79])),
    ("three numbers", ValueError, r"states: expected 4 along axis 3 \(x, y, z, heading\), found 3", lambda a, s: (a, s[..., :3])),
    ("an id too many", ValueError, r"states: expected \d+ along axis 1", lambda a, s: (np.append(a, 7), s)),
    ("an agent is missing", ValueError, r"agent \d+ is missing", lambda a, s: (a[1:], s[:, 1:])),
    ("a stranger", ValueError, r"agent 999999 is not valid at the present step", lambda a, s: (np.append(a, 999999), s[:, [*range(len(a)), 0]])),
    ("an agent twice", ValueError, r"expected agent \d+ once, found it twice", lambda a, s: (np.append(a, a[0]), s[:, [*range(len(a)), 0]])),
    ("no rollouts", ValueError, r"expected at least one rollout, found none", lambda a, s: (a, s[:0])),
    ("text", TypeError, r"states: expected real numbers, found dtype <U1", lambda a, s: (a, np.full(s.shape, "x"))),
    ("complex numbers", TypeError, r"states: expected real numbers, found dtype complex", lambda a, s: (a, s + 1j)),
    ("objects", TypeError, r"states: expected real numbers, found dtype object", lambda a, s: (a, s.astype(object))),
    ("ids that are no numbers", TypeError, r"agent_id: expected whole numbers, found dtype <U", lambda a, s: (a.astype(str), s)),
    ("half an id", TypeError, r"agent_id: expected whole numbers, found float64 that are not", lambda a, s: (a + 0.5, s)),
    ("ids of two axes", ValueError, r"agent_id: expected an array of shape \[A\]", lambda a, s: (a[None], s)),
]


@pytest.mark.parametrize("error, sentence, change", [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_what_is_refused(crossing, error, sentence, change):
    agent_id, states = change(crossing.simulated, moved(crossing, 2))
    with pytest.raises(error, match=sentence):
        gump.wosac.score(crossing, agent_id, states)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_no_number_is_refused(crossing, value):
    states = moved(crossing, 2)
    states[1, 0, 5, 0] = value
    with pytest.raises(ValueError, match=r"rollout 1: expected a number in .* at step 5, found (NaN|inf)"):
        gump.wosac.score(crossing, crossing.simulated, states)


def test_years_scenarios_and_messages_are_refused(crossing):
    states = moved(crossing, 2)
    with pytest.raises(ValueError, match="year: expected one of 2023-v0, 2023, .*, found 2022"):
        gump.wosac.score(crossing, crossing.simulated, states, year=2022)
    with pytest.raises(TypeError, match="scenario: expected a gump.Scenario, found str"):
        gump.wosac.score("scene", crossing.simulated, states)
    with pytest.raises(gump.DataError, match="expected a waymo.open_dataset.ScenarioRollouts message"):
        gump.wosac.score_message(crossing, b"\xff\xff")
    other = gump.wosac.write_rollouts("elsewhere", crossing.simulated, states)
    with pytest.raises(ValueError, match="expected rollouts of scenario .*, found those of elsewhere"):
        gump.wosac.score_message(crossing, other)
    with pytest.raises(ValueError, match="scores: expected at least one scenario, found none"):
        gump.wosac.mean([])
    with pytest.raises(ValueError, match="states: expected 1, one per scenario, found 2"):
        gump.wosac.score_many([crossing], [crossing.simulated], [states, states])
    with pytest.raises(ValueError, match="agent_batch: expected indices of the 1 scenarios, found 1"):
        flat = states.transpose(1, 0, 2, 3)
        batch = np.ones(len(flat), int)
        gump.wosac.score_batch([crossing], crossing.simulated, batch, flat[..., :2], flat[..., 2], flat[..., 3])


def test_scores_are_waymos_fields():
    names = {field.name for field in dataclasses.fields(gump.wosac.Scores)}
    metrics = document(GOLDEN / "metrics_2025.json.gz")["results"]["syn0000000000001"]["noise"]
    assert set(metrics["challenge_2025_sim_agents"]["metrics"]) <= names
