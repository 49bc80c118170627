"""A pytest plugin: `check_env(task)` fails a test with the findings of `rlctl check-env`. It imports pytest only.

def test_my_robot(check_env):
    check_env("my_robots.arm:Arm", ignore=["RL106"])

@pytest.mark.rlctl_tasks("my-robots")  # every task that a distribution installs
def test_tasks(task, check_env):
    check_env(task)
"""

from collections.abc import Callable, Sequence
from typing import Any

import pytest

CheckEnv = Callable[..., None]


def pytest_configure(config: pytest.Config) -> None:
    """Declare the marker."""
    config.addinivalue_line(
        "markers", "rlctl_tasks(distribution): run the test once for each task that a distribution installs, as `task`"
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrize a marked test with the tasks of its distributions."""
    names = [name for marker in metafunc.definition.iter_markers("rlctl_tasks") for name in marker.args]
    if not names:
        return
    from rlctl.environments import installed

    tasks = [entry.name for entry in installed.list_installed() if entry.distribution in names]
    if not tasks:
        listed = ", ".join(map(str, names))
        pytest.fail(f"rlctl_tasks: {listed} installs no tasks; `rlctl tasks` lists the installed ones", pytrace=False)
    metafunc.parametrize("task", tasks)


@pytest.fixture
def check_env() -> CheckEnv:
    """Return a function that checks an environment and fails the test with the findings as its message.

    It takes what `rlctl.check_env` takes, and `strict`: whether warnings fail the test too.
    """

    def check(task: str, *, strict: bool = False, select: Sequence[str] = (), **options: Any) -> None:
        from rlctl.api import check_env as run_check
        from rlctl.errors import RlctlError

        wrong = ("error", "warning") if strict else ("error",)
        try:
            findings = run_check(task, select=select, **options)
        except RlctlError as error:
            raise pytest.fail.Exception(str(error), pytrace=False) from None
        failures = [finding for finding in findings if finding.severity in wrong]
        if failures:
            lines = [f"{finding}\n  fix: {finding.fix}" for finding in failures]
            explain = f"rlctl check-env --explain {failures[0].rule} explains the rule"
            pytest.fail(
                "\n".join([f"{task}: {len(failures)} finding{'' if len(failures) == 1 else 's'}", *lines, explain]),
                pytrace=False,
            )

    return check
