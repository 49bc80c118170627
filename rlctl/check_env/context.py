"""What an experiment works with: instances of the environment, the time it has, and a place to say what it does."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Iterator
from typing import Any, Literal

from rlctl import env_spec, registry
from rlctl.check_env.clock import read_clock
from rlctl.check_env.failures import EnvironmentRaised, describe, failure
from rlctl.check_env.instance import Budget, Instance
from rlctl.check_env.leaves import leaves_of
from rlctl.check_env.messages import Failure
from rlctl.check_env.progress import Progress
from rlctl.errors import TaskError

RenderMode = Literal["rgb_array", "ansi"]


class Context:
    """One child process's view of the environment."""

    def __init__(self, spec: env_spec.EnvSpec, progress: Progress | None = None) -> None:
        self.spec = spec
        self.progress = progress or Progress()
        self.stage = "import"
        """How far the last attempt to build an instance came: `import` or `constructor`."""
        self.budget = Budget(read_clock())
        """What the experiment that is running may use."""
        self.facts: dict[str, Any] = {}
        """The facts that earlier experiments of this process have sent."""
        self._instance: Instance | None = None

    def make(self, render_mode: RenderMode | None = None) -> Any:
        """Return a new environment; whatever the environment raises is an `RlctlError`."""
        self.stage = "import"
        # Loaded before it is built, to distinguish an import error from a constructor's.
        self.progress.enter("load")
        registry.load(self.spec.task)
        self.stage = "constructor"
        self.progress.enter("build")
        env = self.spec.make(render_mode)
        self.progress.leave()
        return env

    def build(self, render_mode: RenderMode | None = None) -> Instance:
        """Return a new instance; what its constructor raises is an `EnvironmentRaised`."""
        try:
            return self._wrap(self.make(render_mode))
        except BaseException as error:
            raise EnvironmentRaised("build") from error

    def build_first(self) -> Instance:
        """Build the instance that this process keeps; raises what the constructor raises."""
        self._instance = self._wrap(self.make())
        return self._instance

    @property
    def instance(self) -> Instance:
        """The instance that this process keeps; built by its first use."""
        if self._instance is None:
            self._instance = self.build()
        return self._instance

    @property
    def is_built(self) -> bool:
        """Whether this process keeps an instance."""
        return self._instance is not None

    @contextlib.contextmanager
    def fresh(self, render_mode: RenderMode | None = None) -> Iterator[Instance]:
        """A new instance for one experiment, closed after it; what its close raises is not this experiment's matter."""
        instance = self.build(render_mode)
        try:
            yield instance
        finally:
            if hasattr(instance.env, "close"):
                with contextlib.suppress(EnvironmentRaised):
                    instance.close()

    def close(self, instance: Instance | None = None) -> Iterator[Failure]:
        """Close an instance, by default the one that this process keeps; yield what it raised."""
        if instance is None:
            self.progress.phase("close")
            instance = self._instance
        if instance is None or not hasattr(instance.env, "close"):
            return
        try:
            instance.close()
        except EnvironmentRaised as error:
            yield failure(error, self.progress)

    def _wrap(self, env: Any) -> Instance:
        try:
            observation_space = getattr(env, "observation_space", None)
        except Exception as error:
            raise TaskError(f"observation_space raises {describe(error)}") from error
        action_leaves = leaves_of(getattr(env, "action_space", None))
        return Instance(env, leaves_of(observation_space), action_leaves, _accepts_seed(env), self.progress)


def _accepts_seed(env: Any) -> bool:
    try:
        parameters = inspect.signature(env.reset).parameters.values()
    except ValueError:  # not written in Python
        return True
    return any(each.name == "seed" or each.kind is each.VAR_KEYWORD for each in parameters)
