"""Rollouts in files of arrays: NumPy's, tables, and what is refused."""

import json

import numpy as np
import pytest

import gump
from conftest import GOLDEN, content


@pytest.fixture(scope="module")
def rollouts():
    return gump.wosac.read_rollouts(content(GOLDEN / "rollouts_syn0000000000001_noise.binproto.gz"))


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_npz(rollouts, tmp_path, save, dtype):
    path = tmp_path / "rollouts.npz"
    states = rollouts.states.astype(dtype)
    save(path, scenario_id=rollouts.scenario_id, agent_id=rollouts.agent_id, states=states, other=np.zeros(3))
    (found,) = gump.wosac.open_rollouts(path)
    assert found.scenario_id == rollouts.scenario_id
    assert np.array_equal(found.agent_id, rollouts.agent_id)
    assert np.array_equal(found.states, rollouts.states)


def explain(path, axes, numbers, agents, **other):
    explanation = {"scenario": "syn0000000000001", "axes": axes, "numbers": numbers, **other}
    explanation["agents"] = [{"id": int(agent), "class": "vehicle"} for agent in agents]
    path.write_text(json.dumps(explanation))


def test_npy_in_any_order_of_axes(rollouts, tmp_path):
    path, beside = tmp_path / "futures.npy", tmp_path / "futures.json"
    velocity = np.zeros_like(rollouts.states[..., :2])
    array = np.concatenate([rollouts.states[..., [0, 1, 3]], velocity], axis=-1).astype(np.float64)
    np.save(path, array.transpose(0, 2, 1, 3))
    explain(beside, ["future", "step", "agent", "number"], ["x", "y", "heading", "vx", "vy"], rollouts.agent_id)
    (found,) = gump.wosac.open_rollouts(path)
    assert np.array_equal(found.states[..., [0, 1, 3]], rollouts.states[..., [0, 1, 3]])
    assert np.isnan(found.states[..., 2]).all()
    np.save(path, rollouts.states.transpose(1, 0, 3, 2))
    explain(beside, ["agent", "future", "number", "step"], ["x", "y", "z", "heading"], rollouts.agent_id, dt=0.1)
    (found,) = gump.wosac.open_rollouts(path)
    assert np.array_equal(found.states, rollouts.states)


def test_the_absent_stay_where_they_were(rollouts, tmp_path):
    path = tmp_path / "rollouts.npz"
    states = rollouts.states.copy()
    states[:, 0, 40:] = np.nan
    states[:, 1, :3] = np.nan
    np.savez(path, scenario_id="s", agent_id=rollouts.agent_id, states=states)
    (found,) = gump.wosac.open_rollouts(path)
    assert np.array_equal(found.agent_id, np.delete(rollouts.agent_id, 1))
    assert (found.states[:, 0, 40:] == states[:, 0, 39:40]).all()


def test_a_table(rollouts, tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    n, agents, steps = (2, *rollouts.states.shape[1:3])
    grid = np.meshgrid(np.arange(n), np.arange(agents), np.arange(steps + 1), indexing="ij")
    future, agent, step = (axis.ravel() for axis in grid)
    states = rollouts.states[future, agent, np.maximum(step - 1, 0)].astype(np.float64)
    columns = {"scenario_id": [rollouts.scenario_id] * len(step), "rollout": future, "step": step}
    columns["track_id"] = rollouts.agent_id[agent]
    columns.update(zip(["x", "y", "z", "heading"], states.T))
    parquet.write_table(pyarrow.table(columns), tmp_path / "futures.parquet")
    (found,) = gump.wosac.open_rollouts(tmp_path / "futures.parquet")
    assert np.array_equal(found.states, rollouts.states[:n])
    assert np.array_equal(found.agent_id, rollouts.agent_id)


def test_messages_are_files_too(rollouts, tmp_path):
    path = tmp_path / "one.binproto"
    path.write_bytes(gump.wosac.write_rollouts("s", rollouts.agent_id, rollouts.states))
    (found,) = gump.wosac.open_rollouts(path)
    assert found.scenario_id == "s" and np.array_equal(found.states, rollouts.states)


def test_what_is_refused(rollouts, tmp_path):
    path = tmp_path / "rollouts.npz"
    given = {"scenario_id": "s", "agent_id": rollouts.agent_id, "states": rollouts.states}

    def refuses(sentence, **changes):
        arrays = {key: value for key, value in {**given, **changes}.items() if value is not None}
        np.savez(path, **arrays)
        with pytest.raises(gump.DataError, match=sentence):
            gump.wosac.open_rollouts(path)

    refuses("expected an array states, found those of scenario_id.npy, agent_id.npy|expected an array states", states=None)
    refuses(r"expected states of shape \[R, A, T, 4\], found", states=rollouts.states[..., :3])
    refuses("expected ids of 7 agents, found|expected ids of .* agents, found", agent_id=rollouts.agent_id[1:])
    refuses("expected text in scenario_id, found numbers", scenario_id=5)
    refuses("expected numbers in agent_id, found text", agent_id=rollouts.agent_id.astype(str))
    refuses("expected values of 32 or 64 bits, or text, found", states=rollouts.states.astype(np.float16))
    refuses("in C order", states=np.asfortranarray(rollouts.states))
    np.savez(path, **given)
    data = path.read_bytes()
    for cut in (10, len(data) // 2, len(data) - 5):
        path.write_bytes(data[:cut])
        with pytest.raises(gump.DataError):
            gump.wosac.open_rollouts(path)
    np.save(tmp_path / "alone.npy", rollouts.states)
    with pytest.raises(gump.DataError, match="alone.json beside it"):
        gump.wosac.open_rollouts(tmp_path / "alone.npy")
    with pytest.raises(FileNotFoundError):
        gump.wosac.open_rollouts(tmp_path / "none.npz")
