"""The pytest plugin: findings fail a test, tasks of a distribution become tests."""

import json
import textwrap

import pytest

pytest_plugins = "pytester"

ENV = """
    import gymnasium, numpy as np
    from gymnasium.spaces import Box

    class Sound(gymnasium.Env):
        observation_space, action_space = Box(-1, 1, (2,)), Box(-1, 1, (1,))
        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.state, self.steps = self.np_random.uniform(-0.5, 0.5, 2).astype(np.float32), 0
            return self.state.copy(), {}
        def step(self, action):
            self.steps += 1
            self.state = (0.9 * self.state + 0.05 * np.float32(action[0])).clip(-1, 1).astype(np.float32)
            return self.state.copy(), -float(abs(self.state).sum()), False, self.steps >= 50, {}

    class NotFinite(Sound):
        def step(self, action):
            state, _, *rest = super().step(action)
            return state, float("nan"), *rest
"""


@pytest.fixture
def robots(pytester):
    pytester.path.joinpath("robots.py").write_text(textwrap.dedent(ENV))
    return pytester


def run(pytester, test):
    pytester.makepyfile(textwrap.dedent(test))
    # By its module, not by its entry point: an installation of before has none.
    return pytester.runpytest_inprocess("-p", "no:rlctl", "-p", "rlctl.pytest_plugin", "-p", "no:cacheprovider")


@pytest.mark.slow
def test_findings_fail_a_test(robots):
    known = {"fingerprint": "robots.py:NotFinite RL601"}
    robots.path.joinpath("baseline.json").write_text(json.dumps({"findings": [known], "known": []}))
    result = run(
        robots,
        """
        def test_sound(check_env):
            check_env("robots.py:Sound", select=["RL6"])

        def test_not_finite(check_env):
            check_env("robots.py:NotFinite", select=["RL601"])

        def test_known(check_env):
            check_env("robots.py:NotFinite", select=["RL601"], baseline="baseline.json")

        def test_missing(check_env):
            check_env("robots.py:Sownd", select=["RL6"])
        """,
    )
    result.assert_outcomes(passed=2, failed=2)
    result.stdout.fnmatch_lines(["*robots.py:NotFinite: 1 finding", "*RL601*", "*fix: *"])
    result.stdout.fnmatch_lines(["*no instance could be built*"])


def test_tasks_of_a_distribution(pytester):
    result = run(
        pytester,
        """
        import pytest

        @pytest.mark.rlctl_tasks("rlctl")
        def test_names(task):
            assert task != "reach"
        """,
    )
    result.assert_outcomes(passed=24, failed=1)


@pytest.mark.slow
def test_a_distribution_without_tasks(pytester):
    result = run(
        pytester,
        """
        import pytest

        @pytest.mark.rlctl_tasks("numpy")
        def test_names(task): ...
        """,
    )
    result.stdout.fnmatch_lines(["*rlctl_tasks: numpy installs no tasks; `rlctl tasks` lists the installed ones"])
