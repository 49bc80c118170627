"""Policies made by hand, servers in a thread, and plain HTTP."""

import asyncio
import contextlib
import json
import threading
import urllib.error
import urllib.request

import numpy as np
from gymnasium import spaces

from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.environments.spec import EnvSpec
from rlctl.play.remote import PolicyClient
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl_robot.serve.serve import make_loop, make_server, serve_until
from rlctl_robot.serve.serve_request import ServeRequest
from tests.play.policies import linear

OBSERVATION = {"positions": [0.1, 0.2], "goal": [1.0, 2.0, 3.0]}
FLAT = np.array([0.1, 0.2, 1.0, 2.0, 3.0], np.float32)


def describe_env(control_dt=0.1, low=-10.0, high=10.0, sizes=None):
    return EnvInfo(
        observation_space=space_to_json(spaces.Box(-np.inf, np.inf, (5,), np.float32)),
        action_space=space_to_json(spaces.Box(low, high, (2,), np.float32)),
        observation_sizes=sizes or {"positions": 2, "goal": 3},
        control_dt=control_dt,
    )


def write_policy(file, factor=1.0, env=None, log_std=-1.0):
    """A policy whose action is the sum and the first of the goal, times a factor."""
    weight = factor * np.array([[0, 0, 1, 1, 1], [0, 0, 1, 0, 0]], np.float32)
    linear(env or describe_env(), weight, log_std).write(file)
    return file


def write_recurrent_policy(file, env=None):
    """A policy with an LSTM of two units: equal observations get other actions as an episode goes on."""
    chance = np.random.default_rng(0)
    shapes = {
        "lstm_actor.weight_ih_l0": (8, 5), "lstm_actor.weight_hh_l0": (8, 2), "lstm_actor.bias_ih_l0": (8,),
        "lstm_actor.bias_hh_l0": (8,), "action_net.weight": (2, 2), "action_net.bias": (2,), "log_std": (2,),
    }  # fmt: skip
    tensors = {f"policy/{name}": chance.normal(0, 1, shape).astype(np.float32) for name, shape in shapes.items()}
    env = env or describe_env()
    info = PolicyInfo(algo="recurrent_ppo", policy="MlpLstmPolicy", env=env, spec=EnvSpec("test"))
    PolicyFile(info, tensors).write(file)
    return file


class RunningServer:
    """A server in a thread of this process."""

    def __init__(self, file, **settings):
        self.server = make_server(file, ServeRequest(port=0, **settings))
        self._end = asyncio.Event()
        self._started = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert self._started.wait(120)

    def _run(self):
        with asyncio.Runner(loop_factory=make_loop) as runner:
            runner.run(self._serve())

    async def _serve(self):
        self._loop = asyncio.get_running_loop()
        await serve_until(self.server, self._take_address, self._end)

    def _take_address(self, address):
        self.address = address
        self.port = int(address.rpartition(":")[2])
        self._started.set()

    def close(self):
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(120)

    @contextlib.contextmanager
    def client(self):
        client = PolicyClient(f"ws://{self.address}")
        try:
            yield client
        finally:
            client.close()

    def get(self, path, body=None, headers=None, method=None):
        """Return status and text."""
        content = body if isinstance(body, bytes | None) else json.dumps(body).encode()
        request = urllib.request.Request(f"http://{self.address}{path}", content, headers or {}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=120) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    def post(self, path, body=b"", **options):
        return self.get(path, body, method="POST", **options)
