"""Motion prediction: official numbers, and what is refused."""

import numpy as np
import pytest

import gump
from conftest import MINI, document, shared

TOLERANCE = 1e-6


def truth(scenario):
    """What really happened at every half second of the targets, NaN where nobody knows."""
    rows = np.searchsorted(scenario.tracks.agent_id, scenario.targets)
    return scenario.tracks.position[rows][:, scenario.now + 5 :: 5, :2][:, :16]


@pytest.fixture(scope="module")
def scenario():
    for one in gump.open(MINI / "procedural.tfrecord.gz"):
        if len(one.targets) >= 2 and np.isfinite(truth(one)).all():
            return one
    raise AssertionError("no scenario whose targets stay")


def test_the_truth_has_no_error(scenario):
    paths = truth(scenario)[:, None]
    found = gump.motion.score(scenario, scenario.targets, paths, np.ones((len(paths), 1)))
    for one in found:
        for horizon in one.horizons:
            assert horizon.min_ade == pytest.approx(0.0, abs=1e-6)
            assert horizon.missed is False


def test_a_metre_beside_is_a_metre(scenario):
    paths = truth(scenario)[:, None] + [0.6, 0.8]
    tally = gump.motion.Tally()
    found = tally.add(scenario, scenario.targets, paths, np.ones((len(paths), 1)))
    assert [horizon.seconds for horizon in found[0].horizons] == [3.0, 5.0, 8.0]
    assert found[0].horizons[0].min_ade == pytest.approx(1.0, abs=1e-6)
    other = gump.motion.Tally()
    other.merge(tally)
    assert other.rows() == tally.rows()
    assert tally.rows()[-1].min_ade == pytest.approx(1.0, abs=1e-6)


def test_a_joint_prediction_is_one(scenario):
    paths = truth(scenario)[:, None]
    found = gump.motion.score(scenario, scenario.targets, paths, [1.0], joint=True)
    assert len(found) == 1 and found[0].agent_id == scenario.targets.tolist()


def test_what_is_refused(scenario):
    paths, confidence = truth(scenario)[:, None], np.ones((len(scenario.targets), 1))

    def refuses(error, sentence, agent_id=scenario.targets, paths=paths, confidence=confidence):
        with pytest.raises(error, match=sentence):
            gump.motion.score(scenario, agent_id, paths, confidence)

    refuses(ValueError, r"paths: expected 16 along axis 2", paths=paths[:, :, :15])
    refuses(ValueError, r"paths: expected an array of shape \[A, K, T, 2\]", paths=paths[:, 0])
    refuses(ValueError, r"confidence: expected 1 along axis 1", confidence=np.ones((len(paths), 2)))
    refuses(ValueError, r"expected a prediction of agent \d+", scenario.targets[1:], paths[1:], confidence[1:])
    refuses(ValueError, r"which is not to be predicted", scenario.targets + 100000)
    refuses(ValueError, r"is not a number", paths=paths * np.nan)
    refuses(ValueError, r"the confidence of mode 0 of agent \d+ is not a number", confidence=confidence * np.nan)
    refuses(TypeError, r"paths: expected real numbers", paths=paths.astype(str))
    refuses(ValueError, r"expected at least one mode", paths=paths[:, :0], confidence=confidence[:, :0])


def varint(data, at):
    """A number of a protobuf message, and where it ends."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


def fields(data, wanted):
    """All values of one field of a protobuf message."""
    at, found = 0, []
    while at < len(data):
        key, at = varint(data, at)
        if key & 7 == 0:
            value, at = varint(data, at)
        else:
            length, at = varint(data, at) if key & 7 == 2 else ({5: 4, 1: 8}[key & 7], at)
            value, at = data[at : at + length], at + length
        if key >> 3 == wanted:
            found.append(value)
    return found


def test_official_numbers():
    """Constant velocity on recorded and made-up scenarios, as the official code measured it."""
    golden = document(shared("golden/wosac/motion/result_cv.json"))
    scenarios = {}
    inputs = "golden/wosac/inputs/scenario_syn0000000000001.tfrecord"
    for path in (inputs, "data/waymo/scenario_a.tfrecord", "data/waymo/scenario_b.tfrecord"):
        (one,) = gump.open(shared(path))
        scenarios[one.id] = one
    predictions = dict(read_submission(shared("golden/wosac/motion/submission_cv.binproto").read_bytes()))
    steps = {5: 0, 9: 1, 15: 2}
    compared = 0
    for expected in golden["scenarios"]:
        scenario = scenarios.get(expected["scenario_id"])
        if scenario is None:
            continue
        found = {}
        agent_id, paths, confidence = predictions[scenario.id]
        for one in gump.motion.score(scenario, agent_id, paths, confidence):
            found[tuple(one.agent_id)] = one.horizons
        for line in expected["predictions"]:
            horizon = found[tuple(line["object_ids"])][steps[line["measurement_step"]]]
            for name in ("min_ade", "min_fde"):
                if line[name]["count"]:
                    assert getattr(horizon, name) == pytest.approx(line[name]["total"], abs=TOLERANCE)
                    compared += 1
            if line["miss"]["count"]:
                assert horizon.missed == bool(line["miss"]["total"])
            assert horizon.overlaps == bool(line["overlap"]["total"])
    assert compared > 50


def read_submission(data):
    """The predictions of a serialized `MotionChallengeSubmission`, read without protobuf: scenario ids
    with agent ids [A], paths [A, K, 16, 2] and confidence [A, K]."""
    for scenario in fields(data, 1):
        agents = []
        for prediction in fields(fields(scenario, 2)[0], 1):
            modes = []
            for scored in fields(prediction, 2):
                (trajectory,) = fields(scored, 1)
                columns = [np.frombuffer(b"".join(fields(trajectory, axis)), "<f4") for axis in (2, 3)]
                modes.append((np.frombuffer(fields(scored, 2)[0], "<f4")[0], np.stack(columns, axis=1)))
            agents.append((fields(prediction, 1)[0], modes))
        agent_id = np.array([agent for agent, _ in agents])
        paths = np.array([[path for _, path in modes] for _, modes in agents], np.float64)
        confidence = np.array([[number for number, _ in modes] for _, modes in agents], np.float64)
        yield fields(scenario, 1)[0].decode(), (agent_id, paths, confidence)
