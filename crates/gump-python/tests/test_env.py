"""Environments in this process: shapes, seeds, modes, speed, and what is refused."""

import numpy as np
import pytest

import gump
from conftest import MINI

try:
    import gymnasium
except ImportError:
    gymnasium = None

without_gymnasium = pytest.mark.skipif(gymnasium is None, reason="no gymnasium here")


@pytest.fixture(scope="module")
def courses():
    reader = gump.open(MINI / "procedural.tfrecord.gz")
    return [next(reader) for _ in range(8)]


def roam(env, n, seed=0):
    """Everything that comes of n random steps."""
    rng = np.random.default_rng(5)
    history = [env.reset(seed=seed)[0]]
    for _ in range(n):
        observations, rewards, terminated, truncated, _ = env.step(env.sample_actions(rng) * 0.5)
        history += [observations, rewards, terminated, truncated]
    return history


def test_shapes_and_types(courses):
    env = gump.VectorEnv(courses, 4)
    observations, infos = env.reset(seed=1)
    assert (observations.shape, observations.dtype) == ((4, *env.observation_shape), np.float32)
    assert infos == {}
    observations, rewards, terminated, truncated, infos = env.step(np.zeros((4, 2)))
    assert (rewards.shape, rewards.dtype) == ((4,), np.float64)
    assert (terminated.dtype, truncated.dtype) == (bool, bool)
    assert np.isfinite(observations).all()
    assert (env.dt, env.num_scenarios, env.action_len) == (0.5, 8, 2)


def test_distant_agents_follow_the_log(courses):
    def of(nearest):
        return roam(gump.VectorEnv(courses, 3, "idm", nearest=nearest), 25, 1)

    def same(one, other):
        return all(np.array_equal(a, b) for a, b in zip(one, other))

    everyone = of(None)
    assert same(of(1000), everyone)
    assert not same(of(1), everyone)


def test_same_seed_same_episodes(courses):
    one, again, other = (roam(gump.VectorEnv(courses, 3), 25, seed) for seed in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(one, again))
    assert not all(np.array_equal(a, b) for a, b in zip(one, other))


def test_an_int_seeds_the_rows_one_after_another(courses):
    together, _ = gump.VectorEnv(courses, 3).reset(seed=7)
    alone = [gump.VectorEnv(courses, 1).reset(seed=7 + i)[0][0] for i in range(3)]
    assert np.array_equal(together, alone)


def until_end(env):
    env.reset(seed=0)
    for _ in range(100):
        result = env.step(np.zeros((env.num_envs, env.action_len)))
        if result[2].any() or result[3].any():
            return result
    raise AssertionError("no end")


def test_next_step(courses):
    env = gump.VectorEnv(courses, 2)
    _, _, terminated, truncated, infos = until_end(env)
    ended = terminated | truncated
    assert np.array_equal(infos["_steps"], ended)
    assert (infos["steps"][ended] > 0).all()
    _, rewards, terminated, truncated, _ = env.step(np.ones((2, 2)))
    assert (rewards[ended] == 0).all() and not (terminated | truncated)[ended].any()


def test_same_step(courses):
    env = gump.VectorEnv(courses, 2, autoreset_mode="same_step")
    observations, _, terminated, truncated, infos = until_end(env)
    ended = terminated | truncated
    assert np.array_equal(infos["_final_obs"], ended)
    for row in np.flatnonzero(ended):
        assert infos["final_obs"][row].shape == env.observation_shape
        assert not np.array_equal(infos["final_obs"][row], observations[row])
        assert infos["final_info"]["steps"][row] > 0


def test_disabled(courses):
    env = gump.VectorEnv(courses, 2, autoreset_mode="disabled")
    _, _, terminated, truncated, _ = until_end(env)
    ended = terminated | truncated
    with pytest.raises(ValueError, match="ended|finished|reset"):
        env.step(np.zeros((2, 2)))
    env.reset(options={"reset_mask": ended})
    env.step(np.zeros((2, 2)))


def test_rasters(courses):
    env = gump.VectorEnv(courses, 2, observation="raster", autoreset_mode="same_step")
    observations, _ = env.reset(seed=0)
    assert observations.dtype == np.uint8 and observations.shape == (2, *env.observation_shape)
    assert set(np.unique(observations)) == {0, 1}
    _, _, terminated, truncated, infos = until_end(env)
    row = np.flatnonzero(terminated | truncated)[0]
    assert infos["final_obs"][row].shape == env.observation_shape


@pytest.mark.parametrize("dynamics, length", [("bicycle", 2), ("next_pose", 3), ("trajectory", 48)])
def test_dynamics(courses, dynamics, length):
    env = gump.VectorEnv(courses, 2, dynamics=dynamics)
    assert env.action_len == length
    env.reset(seed=0)
    env.step(np.zeros((2, length)))


def test_the_expert_stays_near_the_log(courses):
    env = gump.VectorEnv(courses, 8, autoreset_mode="same_step", dynamics="next_pose")
    env.reset(seed=0)
    total = 0.0
    for _ in range(10):
        _, rewards, terminated, _, _ = env.step(env.expert_actions())
        total += rewards.sum()
        assert not terminated.any()
    assert total > 0.0


def test_worlds_move_the_others(courses, network):
    for world in ("idm", network):
        env = gump.VectorEnv(courses, 2, world)
        env.reset(seed=0)
        observations = env.step(np.zeros((2, 2)))[0]
        assert np.isfinite(observations).all()


def test_one_episode_after_another(courses):
    env = gump.Env(courses)
    observation, _ = env.reset(seed=3)
    ended = False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(np.zeros(2))
        ended = terminated or truncated
    assert info["steps"] > 0 and isinstance(reward, float)
    env.reset()
    env.close()


@without_gymnasium
def test_gymnasium_is_content(courses):
    from gymnasium.utils.env_checker import check_env

    check_env(gump.Env(courses), skip_render_check=True)
    env = gump.VectorEnv(courses, 2)
    assert isinstance(env, gymnasium.vector.VectorEnv)
    observations, _ = env.reset(seed=0)
    assert env.observation_space.contains(observations)


def test_stable_baselines_learns(courses):
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO

    from gump.sb3 import Sb3VecEnv

    env = Sb3VecEnv(courses, 4)
    PPO("MlpPolicy", env, n_steps=16, batch_size=32, n_epochs=1).learn(128)
    env.close()


def test_what_is_refused(courses):
    def refuses(sentence, *args, **kwargs):
        with pytest.raises(ValueError, match=sentence):
            gump.VectorEnv(*args, **kwargs)

    refuses("scenario", [])
    refuses("n_envs", courses, 0)
    refuses("observation: expected vector or raster, found pixels", courses, observation="pixels")
    refuses("dynamics: expected bicycle, next_pose or trajectory, found car", courses, dynamics="car")
    refuses("autoreset_mode: expected next_step, same_step or disabled, found never", courses, autoreset_mode="never")
    refuses("horizon", courses, horizon=-1.0)
    with pytest.raises(TypeError, match="scenario: expected a gump.Scenario, found str"):
        gump.VectorEnv(["scene"])
    env = gump.VectorEnv(courses, 2)
    with pytest.raises(ValueError, match="reset"):
        env.step(np.zeros((2, 2)))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="actions: expected 2 along axis 0 .one per environment., found 3"):
        env.step(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="actions: expected an array of shape"):
        env.step(np.zeros(2))
    with pytest.raises(ValueError):
        env.step(np.full((2, 2), np.nan))
    with pytest.raises(ValueError):
        env.step(np.full((2, 2), 5.0))
    with pytest.raises(TypeError, match="actions: expected real numbers"):
        env.step([["left", "right"]] * 2)
    env.step(np.zeros((2, 2)))
    env.close()
    with pytest.raises(ValueError, match="expected an environment that is open, found one that was closed"):
        env.step(np.zeros((2, 2)))
