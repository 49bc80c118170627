"""Failures of environments: the report of a worker, and the error that the main process raises."""

import shlex

from rlctl import errors
from rlctl.errors import EpisodeFailed, RlctlError, TaskError, describe_exception, format_plugin_traceback
from rlctl.processes.pool import WorkerException
from rlctl.rollout.returned_values import InvalidReturn


class FailedInEpisode(Exception):
    """An exception (the cause) was raised in a known episode."""

    def __init__(self, env: int, seed: int, step: int) -> None:
        super().__init__()
        self.where = env, seed, step

    def __str__(self) -> str:
        cause = "" if self.__cause__ is None else f"{describe_exception(self.__cause__)} "
        return "{}in environment {}, episode seed {}, step {},".format(cause, *self.where)


def describe_failure(error: BaseException) -> WorkerException:
    """Return an exception, and where it was raised, as plain data."""
    where: tuple[int, int, int] | None = None
    if isinstance(error, FailedInEpisode):
        where, error = error.where, error.__cause__ or error
    if isinstance(error, RlctlError):
        return WorkerException(str(error), type(error).__name__, error.details, where)
    text = f"ValueError: {error}" if isinstance(error, InvalidReturn) else describe_exception(error)
    return WorkerException(text, "", format_plugin_traceback(error) or None, where)


def make_error(failure: WorkerException, task: str) -> RlctlError:
    """Return the error to raise for a failure; it names the task, and the episode if there is one."""
    message, details = failure.message, failure.details
    kind = getattr(errors, failure.kind) if failure.kind else TaskError
    if kind is TaskError and task not in message.partition("\n")[0]:
        message = f"task {task!r}: {message}"
    if failure.where is not None:
        if kind is TaskError:
            return EpisodeFailed(message, *failure.where, hint=format_hint(task), details=details)
        # The policy or its server failed: check-env would not show it.
        message += "\nin environment {}, episode seed {}, step {}".format(*failure.where)
    result: RlctlError = kind(message, details=details)
    return result


def format_hint(task: str) -> str:
    """Return the command that tests an environment without a training."""
    return f"to see it alone: rlctl check-env {shlex.quote(task)}"
