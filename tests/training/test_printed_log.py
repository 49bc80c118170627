"""What environments print during a training: once on stderr with a count, all of it in the run folder."""

import pytest

SLIDER = """
    import gymnasium, numpy as np
    from .limits import REACH

    class Slider(gymnasium.Env):
        action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)

        def __init__(self):
            print("parameters loaded")
            print(*(f"gain {number}" for number in range(3)), sep="\\n")

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.count, self.x = 0, self.np_random.uniform(-REACH, REACH, 1).astype(np.float32)
            return self.x.copy(), {}

        def step(self, action):
            self.count += 1
            self.x = np.clip(self.x + 0.1 * np.clip(action, -1, 1), -REACH, REACH).astype(np.float32)
            return self.x.copy(), -abs(float(self.x[0])), False, self.count >= 20, {}
"""


@pytest.mark.slow
def test_the_prints_of_many_environments(rlctl, write_module, tmp_path):
    write_module("robots/__init__.py", "")
    write_module("robots/limits.py", "REACH = 1.0\n")
    write_module("robots/slider.py", SLIDER)
    settings = ("algo_kwargs.n_steps=32", "algo_kwargs.batch_size=64", "eval.episodes=1")
    options = [part for setting in settings for part in ("--set", setting)]
    done = rlctl("train", "robots/slider.py:Slider", "-n", "256", "--n-envs", "4", *options)
    assert done.returncode == 0, done.stderr
    (run,) = (tmp_path / "runs" / "Slider").iterdir()
    lines = done.stderr.splitlines()
    for text in ("parameters loaded", "gain 0", "gain 1", "gain 2"):
        assert lines.count(text) == 1
    # Four environments for training, and one for evaluations.
    assert f"(4 times each: parameters loaded and 3 other lines; all lines: {run.relative_to(tmp_path)}/" in done.stderr
    assert (run / "printed.log").read_text().splitlines().count("gain 1") == 5
    assert "gain" not in done.stdout
