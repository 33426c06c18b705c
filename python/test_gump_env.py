"""Tests of gump_env.py against a running server: `test_gump_env.py SOCKET`.

`cargo test -p gump-rl --test server` starts one and runs this. What needs gymnasium or
stable-baselines3 is skipped where they are missing, and says so.
"""

import sys
import unittest

import numpy as np

import gump_env
from gump_env import GumpEnv, GumpError, GumpVectorEnv

try:
    import stable_baselines3
    from gump_sb3 import GumpSb3VecEnv
except ImportError:
    stable_baselines3 = None

SOCKET = ""
without_gymnasium = unittest.skipIf(gump_env.gymnasium is None, "no gymnasium here")
without_sb3 = unittest.skipIf(stable_baselines3 is None, "no stable-baselines3 here")


def roam(env, n, seed=0):
    """Everything that comes of n random steps."""
    rng = np.random.default_rng(5)
    history = [env.reset(seed=seed)[0]]
    for _ in range(n):
        observations, rewards, terminated, truncated, _ = env.step(env.sample_actions(rng) * 0.5)
        history += [observations, rewards, terminated, truncated]
    return history


class VectorEnv(unittest.TestCase):
    def env(self, *args, **kwargs):
        env = GumpVectorEnv(SOCKET, *args, **kwargs)
        self.addCleanup(env.close)
        return env

    def test_shapes_and_types(self):
        env = self.env(4)
        observations, infos = env.reset(seed=1)
        self.assertEqual((observations.shape, observations.dtype), ((4, *env.observation_shape), np.float32))
        self.assertEqual(infos, {})
        observations, rewards, terminated, truncated, infos = env.step(np.zeros((4, 2)))
        self.assertEqual((rewards.shape, rewards.dtype), ((4,), np.float64))
        self.assertEqual((terminated.dtype, truncated.dtype), (bool, bool))
        self.assertTrue(np.isfinite(observations).all())
        self.assertEqual((env.dt, env.num_scenarios), (0.5, 8))

    def test_same_seed_same_episodes(self):
        one, again, other = (roam(self.env(3), 25, seed) for seed in (1, 1, 2))
        self.assertTrue(all(np.array_equal(a, b) for a, b in zip(one, again)))
        self.assertFalse(all(np.array_equal(a, b) for a, b in zip(one, other)))

    def test_an_int_seeds_the_rows_one_after_another(self):
        together, _ = self.env(3).reset(seed=7)
        alone = [self.env(1).reset(seed=7 + i)[0][0] for i in range(3)]
        self.assertTrue(np.array_equal(together, alone))

    def until_end(self, env):
        env.reset(seed=0)
        for _ in range(100):
            result = env.step(np.zeros((env.num_envs, env.action_len)))
            if result[2].any() or result[3].any():
                return result
        self.fail("no end")

    def test_next_step(self):
        env = self.env(2)
        _, _, terminated, truncated, infos = self.until_end(env)
        ended = terminated | truncated
        self.assertTrue(np.array_equal(infos["_steps"], ended))
        self.assertTrue((infos["steps"][ended] > 0).all())
        _, rewards, terminated, truncated, _ = env.step(np.ones((2, 2)))
        self.assertTrue((rewards[ended] == 0).all() and not (terminated | truncated)[ended].any())

    def test_same_step(self):
        env = self.env(2, "same_step")
        observations, _, terminated, truncated, infos = self.until_end(env)
        row = int((terminated | truncated).argmax())
        self.assertTrue(infos["_final_obs"][row])
        self.assertFalse(np.array_equal(infos["final_obs"][row], observations[row]))
        self.assertGreater(infos["final_info"]["steps"][row], 0)

    def test_disabled(self):
        env = self.env(2, "disabled")
        _, _, terminated, truncated, _ = self.until_end(env)
        with self.assertRaises(GumpError) as refused:
            env.step(np.zeros((2, 2)))
        self.assertIn("reset the row first", str(refused.exception))
        env.reset(options={"reset_mask": terminated | truncated})
        env.step(np.zeros((2, 2)))

    def test_rasters(self):
        env = self.env(2, observation="raster")
        observations, _ = env.reset(seed=0)
        self.assertEqual((observations.shape, observations.dtype), ((2, 8, 64, 64), np.uint8))
        self.assertEqual(set(np.unique(observations)), {0, 1})

    def test_other_dynamics(self):
        for dynamics, length in (("next_pose", 3), ("trajectory", 48)):
            env = self.env(2, dynamics=dynamics)
            env.reset(seed=0)
            self.assertEqual(env.action_len, length)
            env.step(env.sample_actions())

    def test_bad_actions_are_refused(self):
        env = self.env(2)
        env.reset(seed=0)
        for action, what in ((np.nan, "not a finite number"), (1.5, "expected -1 to 1")):
            with self.assertRaises(GumpError) as refused:
                env.step(np.full((2, 2), action))
            self.assertIn(what, str(refused.exception))
        env.step(np.zeros((2, 2)))

    def test_arrays_of_another_shape_are_not_sent(self):
        env = self.env(2)
        with self.assertRaisesRegex(ValueError, r"^seed: expected an array of shape \[2\], found \[3\]$"):
            env.reset(seed=[1, 2, 3])
        env.reset(seed=0)
        for shape in ((3, 2), (2, 3), (2,), (4,), ()):
            found = f"expected an array of shape [2, 2], found {list(shape)}"
            with self.assertRaises(ValueError) as refused:
                env.step(np.zeros(shape))
            self.assertEqual(str(refused.exception), f"actions: {found}")
        with self.assertRaisesRegex(ValueError, "reset_mask"):
            env.reset(options={"reset_mask": [True]})
        # The server has heard of none of this.
        env.step(np.zeros((2, 2)))

    def test_a_server_that_is_not_there_is_named(self):
        missing = SOCKET + ".missing"
        with self.assertRaises(FileNotFoundError) as refused:
            GumpVectorEnv(missing)
        self.assertIn(missing, str(refused.exception))

    @without_gymnasium
    def test_it_is_a_gymnasium_vector_env(self):
        gymnasium = gump_env.gymnasium
        env = self.env(3)
        self.assertIsInstance(env, gymnasium.vector.VectorEnv)
        observations, _ = env.reset(seed=0)
        self.assertIn(observations, env.observation_space)
        env.action_space.seed(0)
        recorded = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
        recorded.reset(seed=0)
        ended = 0
        for _ in range(40):
            infos = recorded.step(env.action_space.sample() * np.float32(0.3))[4]
            ended += int(np.sum(infos.get("_episode", False)))
        self.assertGreater(ended, 2)


class Env(unittest.TestCase):
    def env(self):
        env = GumpEnv(SOCKET)
        self.addCleanup(env.close)
        return env

    def test_an_episode(self):
        env = self.env()
        env.reset(seed=0)
        for _ in range(100):
            _, _, terminated, truncated, infos = env.step(np.zeros(2, np.float32))
            if terminated or truncated:
                self.assertGreater(infos["steps"], 0)
                return
        self.fail("no end")

    def test_an_action_of_another_shape_is_not_sent(self):
        env = self.env()
        env.reset(seed=0)
        with self.assertRaisesRegex(ValueError, r"^action: expected an array of shape \[2\], found \[3\]$"):
            env.step(np.zeros(3))
        env.step(np.zeros(2))

    @without_gymnasium
    def test_gymnasiums_checker_is_content(self):
        from gymnasium.utils.env_checker import check_env

        check_env(self.env(), skip_render_check=True)

    @without_sb3
    def test_a_known_library_trains(self):
        from stable_baselines3.common.env_checker import check_env

        env = self.env()
        check_env(env)
        model = stable_baselines3.SAC("MlpPolicy", env, learning_starts=100, seed=0, device="cpu")
        model.learn(300)
        self.assertEqual(model.num_timesteps, 300)


class Sb3VecEnv(unittest.TestCase):
    @without_sb3
    def test_rows_end_as_the_library_expects(self):
        env = GumpSb3VecEnv(SOCKET, 3)
        self.addCleanup(env.close)
        same = GumpVectorEnv(SOCKET, 3, "same_step")
        self.addCleanup(same.close)
        env.seed(7)
        expected, _ = same.reset(seed=7)
        self.assertTrue(np.array_equal(env.reset(), expected))
        ended = 0
        for _ in range(40):
            actions = same.sample_actions()
            observations, rewards, dones, infos = env.step(actions)
            expected = same.step(actions)
            self.assertTrue(np.array_equal(observations, expected[0]))
            self.assertTrue(np.allclose(rewards, expected[1]))
            self.assertTrue(np.array_equal(dones, expected[2] | expected[3]))
            for row in np.flatnonzero(dones):
                last = expected[4]["final_obs"][row]
                self.assertTrue(np.array_equal(infos[row]["terminal_observation"], last))
                self.assertEqual(infos[row]["TimeLimit.truncated"], bool(expected[3][row]))
                ended += 1
        self.assertGreater(ended, 2)

    @without_sb3
    def test_a_known_library_trains_on_many_rows(self):
        env = GumpSb3VecEnv(SOCKET, 4)
        self.addCleanup(env.close)
        model = stable_baselines3.PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=2, seed=0, device="cpu")
        before = model.policy.action_net.weight.detach().clone()
        model.learn(512)
        self.assertEqual(model.num_timesteps, 512)
        self.assertFalse(bool((before == model.policy.action_net.weight).all()))
        self.assertGreater(len(model.ep_info_buffer), 0)


if __name__ == "__main__":
    SOCKET = sys.argv.pop(1)
    unittest.main()
