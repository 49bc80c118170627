import time

from rlctl.environments.spec import EnvSpec
from rlctl.replaying.film import show_episodes
from rlctl.replaying.report import ReplayResult, show
from rlctl.task.bullet import pybullet


def test_episodes_take_their_time():
    spec = EnvSpec("reach")
    env = spec.make()
    arrived = []

    def begin(seed):
        arrived.append(time.monotonic())
        return lambda observation, step: env.action_space.sample() if step < 12 else None

    (rollout,) = show_episodes(env, spec, [1], begin)
    env.close()
    assert rollout.length == 12
    # 12 steps of 1/60 s.
    assert time.monotonic() - arrived[0] >= 0.2


def test_closing_the_window_ends_it_well():
    spec = EnvSpec("reach")
    env = spec.make()

    def choose(observation, step):
        if step == 3:
            pybullet.disconnect(physicsClientId=env.unwrapped.sim.client)
        return env.action_space.sample()

    assert show_episodes(env, spec, [1, 2], lambda seed: choose) == []
    env.close()


def test_a_window_that_was_closed_at_once_is_no_error(tmp_path):
    show(ReplayResult("reach", "best.safetensors", []), str(tmp_path / "result.json"))
    assert '"episodes": []' in (tmp_path / "result.json").read_text()
