"""Worlds: what they imagine, step by step too, scenes from nothing, and what is refused."""

import os

import numpy as np
import pytest

import gump
from conftest import MINI

RULES = ["idm", "constant-velocity", "log"]


@pytest.mark.parametrize("name", RULES)
def test_rules_imagine(crossing, name):
    world = gump.World(name)
    states = world.simulate(crossing, futures=2, seconds=3.0)
    assert states.shape == (2, len(crossing.simulated), 30, 4)
    assert states.dtype == np.float64 and np.isfinite(states).all()
    assert world.name == name and name in repr(world)


def test_the_log_is_what_happened(crossing):
    (states,) = gump.World("log").simulate(crossing, futures=1, hold=False)
    plane = [0, 1, 3]
    assert np.array_equal(states[..., plane], crossing.future[..., plane], equal_nan=True)
    # Heights are those over the road.
    assert np.allclose(states, crossing.future, atol=0.1, equal_nan=True)
    (held,) = gump.World("log").simulate(crossing, futures=1)
    there = np.isfinite(states)
    assert np.isfinite(held).all() and np.array_equal(held[there], states[there])


def test_constant_velocity_goes_straight_on(crossing):
    states = gump.World("constant-velocity").simulate(crossing, futures=1, seconds=2.0)[0]
    tracks = crossing.tracks
    rows = np.searchsorted(tracks.agent_id, crossing.simulated)
    now, velocity = tracks.position[rows, crossing.now, :2], tracks.velocity[rows, crossing.now]
    assert np.allclose(states[:, 19, :2], now + 2.0 * velocity, atol=1e-6)


def test_a_network_imagines(crossing, network):
    states = network.simulate(crossing, futures=3, seconds=2.0, seed=5)
    assert states.shape == (3, len(crossing.simulated), 20, 4) and np.isfinite(states).all()
    again = network.simulate(crossing, futures=3, seconds=2.0, seed=5)
    assert np.array_equal(states, again)
    assert not np.array_equal(states[0], states[1])
    other = network.simulate(crossing, futures=3, seconds=2.0, seed=6)
    assert not np.array_equal(states, other)
    tracks = crossing.tracks
    rows = np.searchsorted(tracks.agent_id, crossing.simulated)
    moved = np.linalg.norm(states[:, :, 0, :2] - tracks.position[rows, crossing.now, :2], axis=-1)
    assert moved.max() < 5.0


def test_former_names_of_arguments_work():
    with pytest.warns(DeprecationWarning, match="life is now spawn"):
        gump.World("idm", life=True)


def test_more_real_than_going_straight_on(crossing, network):
    def score(world):
        states = world.simulate(crossing, futures=16)
        return gump.wosac.score(crossing, crossing.simulated, states).metametric

    assert score(network) > score(gump.World("constant-velocity")) + 0.05


def test_the_shipped_weights_are_found(network):
    for path in (gump.worlds.SHIPPED_WEIGHTS, gump.worlds.GENERATOR_WEIGHTS):
        assert path.is_file()
        assert gump.World(f"model:{path}").name == f"model:{path}"


def test_steps_are_what_simulate_does(crossing):
    world = gump.World("idm")
    whole = world.simulate(crossing, futures=2, seconds=1.0, hold=False)
    with world.start(crossing, futures=2) as session:
        assert np.array_equal(session.agent_id, crossing.simulated)
        stride = round(session.dt / crossing.dt)
        for step in range(stride, 11, stride):
            found = session.step()
            assert found.states.shape == (2, len(session.agent_id), 4)
            assert np.allclose(found.states[..., :2], whole[:, :, step - 1, :2], equal_nan=True)


def test_a_driven_ego_is_where_it_was_put(crossing, network):
    for world in (gump.World("idm"), network):
        session = world.start(crossing, futures=2)
        row = session.agent_id.tolist().index(crossing.ego)
        tracks = crossing.tracks
        own = tracks.agent_id.tolist().index(crossing.ego)
        x, y, _ = tracks.position[own, crossing.now]
        ego = np.array([[x, y, 0.25, 1.0, 0.0], [x + 1.0, y, 0.25, 1.0, 0.0]])
        found = session.step(ego)
        assert np.allclose(found.states[:, row, :2], ego[:, :2])
        assert np.allclose(found.states[:, row, 3], 0.25)


def test_many_sessions_side_by_side(crossing):
    world = gump.World("idm")
    sessions = [world.start(crossing, seed=i) for i in range(5)]
    steps = [[session.step().states for session in sessions] for _ in range(3)]
    assert all(np.array_equal(row[0], one, equal_nan=True) for row in steps for one in row)
    for session in sessions:
        session.close()
    again = world.start(crossing)
    assert np.array_equal(again.step().states, steps[0][0], equal_nan=True)


def test_what_sessions_refuse(crossing):
    session = gump.World("idm").start(crossing, futures=2)
    with pytest.raises(ValueError, match=r"ego: expected an array of shape \[R, 5\]"):
        session.step(np.zeros(5))
    with pytest.raises(ValueError, match="ego: expected 2 along axis 0 .one per future., found 3"):
        session.step(np.zeros((3, 5)))
    with pytest.raises(ValueError, match="ego: expected numbers, found one that is none in row 1"):
        session.step([[0.0] * 5, [np.nan] * 5])
    session.close()
    with pytest.raises(ValueError, match="expected a session that is open, found one that was closed"):
        session.step()


def test_a_session_does_not_survive_a_fork(crossing):
    session = gump.World("idm").start(crossing)
    session.step()
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            session.step()
            os.write(write, b"it went on")
        except RuntimeError as error:
            os.write(write, str(error).encode())
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        assert "found one forked from it" in pipe.read()
    os.waitpid(child, 0)


def test_what_worlds_refuse(crossing, tmp_path):
    with pytest.raises(ValueError, match="world: expected log, idm, .*, found IDM"):
        gump.World("IDM")
    with pytest.raises(TypeError, match="world: expected a name, found int"):
        gump.World(5)
    with pytest.raises(FileNotFoundError, match="expected weights, found no file"):
        gump.World(f"model:{tmp_path / 'none.safetensors'}")
    (tmp_path / "bad.safetensors").write_bytes(b"no weights")
    with pytest.raises(gump.DataError, match="bad.safetensors"):
        gump.World(f"model:{tmp_path / 'bad.safetensors'}")
    with pytest.raises(ValueError, match="temperature: expected a number above 0, found 0"):
        gump.World("model", temperature=0.0)
    with pytest.raises(ValueError, match="top_k: expected at least 1"):
        gump.World("model", top_k=0)
    with pytest.raises(ValueError, match="top_p: expected a number above 0 and at most 1"):
        gump.World("model", top_p=1.5)
    with pytest.raises(ValueError, match="precision: expected f32, bf16 or int8, found f64"):
        gump.World("model", precision="f64")
    with pytest.raises(ValueError, match="expected raw or paper, found both"):
        gump.World("model", raw=True, paper=True)
    world = gump.World("idm")
    with pytest.raises(ValueError, match="futures: expected at least 1, found 0"):
        world.simulate(crossing, futures=0)
    with pytest.raises(ValueError, match="second|duration|positive"):
        world.simulate(crossing, seconds=float("nan"))
    with pytest.raises(ValueError, match="second|duration|positive"):
        world.simulate(crossing, seconds=-1.0)
    with pytest.raises((OverflowError, TypeError)):
        world.simulate(crossing, seed=-1)


def test_scenes_from_nothing(crossing):
    made = gump.generate(crossing, vehicles=4, pedestrians=1, count=2, seed=3)
    assert len(made) == 2
    for scene in made:
        kinds = scene.scenario.tracks.kind
        assert kinds.count("vehicle") == 5 and kinds.count("pedestrian") == 1
        assert scene.attempts >= 1 and isinstance(scene.holds, bool)
    (moving,) = gump.generate(crossing, vehicles=2, seconds=2.0, seed=3)
    assert len(moving.scenario) - moving.scenario.now - 1 == 20
    # Another world moves the same scene.
    still = gump.World("constant-velocity")
    (steady,) = gump.generate(crossing, vehicles=2, seconds=2.0, seed=3, traffic=still)
    now, later = steady.scenario.now, len(steady.scenario) - 1
    tracks, moved = steady.scenario.tracks, moving.scenario.tracks
    assert (tracks.position[:, now] == moved.position[:, now]).all()
    assert (tracks.position[:, later] != moved.position[:, later]).any()
    expected = tracks.position[:, now, :2] + 2.0 * tracks.velocity[:, now]
    assert np.allclose(tracks.position[:, later, :2], expected, atol=1e-3)
    with pytest.raises(ValueError, match="traffic: expected a world that simulates new scenes, found log"):
        gump.generate(crossing, vehicles=2, traffic=gump.World("log"))
    with pytest.raises(ValueError, match='prompt: "behnd_bike" is not one of the 73 scenario tags'):
        gump.generate(crossing, "behnd_bike")
    for other in ("idm", "model"):
        with pytest.raises(ValueError, match="world: expected a network that generates scenes"):
            gump.generate(crossing, world=gump.World(other))
    with pytest.raises(ValueError, match="seconds: expected a number from 0 to 3600, found -1"):
        gump.generate(crossing, seconds=-1.0)
    with pytest.raises(ValueError, match="objects: "):
        gump.generate(crossing, objects="no TOML")
