"""Driving environments of gump for Python, over a Unix socket.

One file, no build: copy it wherever it is needed. It wants numpy; with gymnasium installed
`GumpVectorEnv` is a `gymnasium.vector.VectorEnv` and `GumpEnv` a `gymnasium.Env`, without it they
have the same methods.

    cargo xtask rl serve --socket /tmp/gump.sock --scenarios DIR --world log

    from gump_env import GumpVectorEnv
    with GumpVectorEnv("/tmp/gump.sock", num_envs=128) as env:
        observations, infos = env.reset(seed=0)
        observations, rewards, terminated, truncated, infos = env.step(env.sample_actions())

The protocol is described in `crates/gump-rl/src/server/mod.rs`; `gump_sb3.py` beside this file
brings all rows to Stable-Baselines3.
"""

import socket
import struct

import numpy as np

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space

    _VectorBase, _Base = gymnasium.vector.VectorEnv, gymnasium.Env
except ImportError:
    gymnasium = None
    _VectorBase = _Base = object

_HELLO, _RESET, _STEP, _GOODBYE, _READY, _OBSERVATIONS, _STEPPED, _ERROR = 1, 2, 3, 4, 65, 66, 67, 127
_AUTORESET = {"next_step": 0, "same_step": 1, "disabled": 2}
_OBSERVATION = {"vector": 0, "raster": 1}
_DYNAMICS = {"bicycle": 0, "next_pose": 1, "trajectory": 2}
_MAKES_NO_SENSE = 1


class GumpError(RuntimeError):
    """What the server refused, in its words. `code` is the protocol's."""

    def __init__(self, code, message):
        super().__init__(message)
        self.code = code


class _Connection:
    """Frames to and from the server: a length, a kind, a body."""

    def __init__(self, path):
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.connect(path)
        except OSError as error:
            self._socket.close()
            # Of the same class, with the path, which the socket's own error lacks.
            raise OSError(error.errno, f"no server can be reached ({error.strerror})", str(path)) from None

    def tell(self, kind, body=b""):
        try:
            self._socket.sendall(struct.pack("<IB", len(body), kind) + body)
        except (BrokenPipeError, ConnectionResetError):
            raise ConnectionError(self._hung_up()) from None

    def ask(self, kind, body, expected):
        self.tell(kind, body)
        length, found = struct.unpack("<IB", self._read(5))
        answer = self._read(length)
        if found == _ERROR:
            raise GumpError(answer[0], bytes(answer[1:]).decode())
        if found != expected:
            raise GumpError(_MAKES_NO_SENSE, f"expected an answer of kind {expected}, found {found}")
        return answer

    def close(self):
        self._socket.close()

    def _read(self, length):
        data = bytearray(length)
        view, got = memoryview(data), 0
        while got < length:
            try:
                n = self._socket.recv_into(view[got:])
            except ConnectionResetError:
                n = 0
            if n == 0:
                raise ConnectionError(self._hung_up())
            got += n
        return data

    def _hung_up(self):
        return f"the server at {self._path} has closed the connection: make another environment"


def _shaped(values, dtype, shape, what):
    """An array of this type; ValueError with both shapes if it has another one."""
    array = np.ascontiguousarray(values, dtype)
    # Arrays without an axis would get one above.
    found = np.shape(values)
    if found != shape:
        raise ValueError(f"{what}: expected an array of shape {list(shape)}, found {list(found)}")
    return array


class _Body:
    """Takes an answer apart, front to back."""

    def __init__(self, data):
        self._data, self._at = data, 0

    def array(self, dtype, *shape):
        n = int(np.prod(shape))
        found = np.frombuffer(self._data, dtype, n, self._at).reshape(shape)
        self._at += n * np.dtype(dtype).itemsize
        return found

    def number(self, dtype):
        return self.array(dtype, 1)[0].item()


class GumpVectorEnv(_VectorBase):
    """Many episodes of driving side by side.

    Observations are float32 `[num_envs, numbers]` ("vector") or uint8 0 or 1 `[num_envs, layer,
    row, column]` ("raster"), actions float32 in [-1, 1]. When an episode ends, `infos` tells its
    scenario, steps, return, metres of progress, and whether it collided, left the road or was
    uncomfortable; in the mode "same_step" under `final_info`, as Gymnasium has it.
    """

    def __init__(self, path, num_envs=1, autoreset_mode="next_step", observation="vector", dynamics="bicycle"):
        self.num_envs = num_envs
        self._mode = autoreset_mode
        self._connection = _Connection(path)
        choices = _AUTORESET[autoreset_mode], _OBSERVATION[observation], _DYNAMICS[dynamics]
        hello = b"GUMP" + struct.pack("<HBBBI", 1, *choices, num_envs)
        ready = _Body(self._connection.ask(_HELLO, hello, _READY))
        ready.number("<u4")
        self.action_len = ready.number("<u4")
        self.dt = ready.number("<f8")
        self.num_scenarios = ready.number("<u4")
        self._packed = bool(ready.number("u1"))
        self.observation_shape = tuple(ready.array("<u4", ready.number("u1")).tolist())
        self._seeds = np.random.default_rng()
        self._is_open = True
        self._was_reset = False
        if gymnasium:
            box = gymnasium.spaces.Box
            if self._packed:
                self.single_observation_space = box(0, 1, self.observation_shape, np.uint8)
            else:
                self.single_observation_space = box(-np.inf, np.inf, self.observation_shape, np.float32)
            self.single_action_space = box(-1.0, 1.0, (self.action_len,), np.float32)
            self.observation_space = batch_space(self.single_observation_space, num_envs)
            self.action_space = batch_space(self.single_action_space, num_envs)
            self.metadata = {"autoreset_mode": AutoresetMode[autoreset_mode.upper()]}
            self.spec = None

    def reset(self, *, seed=None, options=None):
        """Starts episodes. An int seeds the rows with `seed`, `seed + 1`, ...; without a seed rows
        go on to their next episode. `options={"reset_mask": bools}` restarts some rows only.
        """
        mask = (options or {}).get("reset_mask")
        if isinstance(seed, (int, np.integer)):
            self._seeds = np.random.default_rng(seed)
            seeds = [seed + i for i in range(self.num_envs)]
        elif seed is None:
            seeds = None if self._was_reset else self._draw(self.num_envs)
        else:
            seeds = [self._draw(1)[0] if one is None else one for one in seed]
        body = struct.pack("B", (seeds is not None) | (mask is not None) << 1)
        if seeds is not None:
            body += _shaped(seeds, "<u8", (self.num_envs,), "seed").tobytes()
        if mask is not None:
            body += _shaped(mask, bool, (self.num_envs,), "reset_mask").tobytes()
        answer = _Body(self._connection.ask(_RESET, body, _OBSERVATIONS))
        self._was_reset = True
        return self._observations(answer, self.num_envs), {}

    def step(self, actions):
        """One action per row, `[num_envs, action_len]` in [-1, 1]; ValueError for another shape."""
        body = _shaped(actions, "<f4", (self.num_envs, self.action_len), "actions").tobytes()
        answer = _Body(self._connection.ask(_STEP, body, _STEPPED))
        n = self.num_envs
        observations = self._observations(answer, n)
        rewards = answer.array("<f4", n).astype(np.float64)
        terminated, truncated, _restarted = (answer.array("u1", n).astype(bool) for _ in range(3))
        infos = self._infos(answer, answer.number("<u4"))
        return observations, rewards, terminated, truncated, infos

    def sample_actions(self, rng=None):
        """Random actions, for want of a policy."""
        rng = rng or self._seeds
        return rng.uniform(-1.0, 1.0, (self.num_envs, self.action_len)).astype(np.float32)

    def close(self, **_):
        """Says goodbye; the episodes in progress end here."""
        if self._is_open:
            self._is_open = False
            try:
                self._connection.tell(_GOODBYE)
            except OSError:
                pass  # It hung up first.
            self._connection.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def __del__(self):
        if getattr(self, "_is_open", False):
            self.close()

    def _draw(self, n):
        return self._seeds.integers(0, 2**63, n).tolist()

    def _observations(self, body, n):
        if not self._packed:
            return body.array("<f4", n, *self.observation_shape).copy()
        bits = body.array("u1", n * int(np.prod(self.observation_shape)) // 8)
        return np.unpackbits(bits, bitorder="little").reshape(n, *self.observation_shape)

    def _infos(self, body, n_ended):
        if n_ended == 0:
            return {}
        ended = np.zeros(self.num_envs, bool)
        kinds = {"scenario": int, "steps": int, "return": float, "progress": float}
        kinds |= {"collided": bool, "off_road": bool, "uncomfortable": bool}
        infos = {key: np.zeros(self.num_envs, kind) for key, kind in kinds.items()}
        finals = np.full(self.num_envs, None, object)
        for _ in range(n_ended):
            row = body.number("<u4")
            numbers = *body.array("<u4", 2), *body.array("<f4", 2), *body.array("u1", 3)
            for values, number in zip(infos.values(), numbers):
                values[row] = number
            finals[row] = self._observations(body, 1)[0]
            ended[row] = True
        infos |= {f"_{key}": ended.copy() for key in infos}
        if self._mode != "same_step":
            return infos
        return {"final_obs": finals, "_final_obs": ended, "final_info": infos, "_final_info": ended.copy()}


class GumpEnv(_Base):
    """One episode after another: for libraries that want a plain environment."""

    metadata = {"render_modes": []}

    def __init__(self, path, observation="vector", dynamics="bicycle"):
        self._rows = GumpVectorEnv(path, 1, "disabled", observation, dynamics)
        if gymnasium:
            self.observation_space = self._rows.single_observation_space
            self.action_space = self._rows.single_action_space

    def reset(self, *, seed=None, options=None):
        """Starts the next episode, or the first of another seed."""
        if gymnasium:
            super().reset(seed=seed)
        observations, infos = self._rows.reset(seed=seed)
        return observations[0], infos

    def step(self, action):
        """One action, `[action_len]` in [-1, 1]."""
        action = _shaped(action, "<f4", (self._rows.action_len,), "action")
        observations, rewards, terminated, truncated, infos = self._rows.step(action[None])
        infos = {key: value[0] for key, value in infos.items() if not key.startswith("_")}
        return observations[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), infos

    def close(self):
        """Says goodbye."""
        self._rows.close()
