"""What a worker reports of an environment that failed."""

from __future__ import annotations

from typing import Any

from rlctl.errors import RlctlError, describe_exception, format_plugin_traceback
from rlctl.rollout.returned_values import InvalidReturn


class FailedInEpisode(Exception):
    """An exception (the cause) was raised in a known episode."""

    def __init__(self, env: int, seed: int, step: int) -> None:
        super().__init__()
        self.where = {"env": env, "seed": seed, "step": step}

    def __str__(self) -> str:
        cause = "" if self.__cause__ is None else f"{describe_exception(self.__cause__)} "
        return "{}in environment {env}, episode seed {seed}, step {step},".format(cause, **self.where)


def encode_error(error: BaseException) -> dict[str, Any]:
    """Return what was raised, and where, as plain data for `Workers`."""
    where: dict[str, int] = {}
    if isinstance(error, FailedInEpisode):
        where, error = error.where, error.__cause__ or error
    if isinstance(error, RlctlError):
        return {"message": str(error), "kind": type(error).__name__, "traceback": error.details, **where}
    text = f"ValueError: {error}" if isinstance(error, InvalidReturn) else describe_exception(error)
    return {"message": text, "kind": None, "traceback": format_plugin_traceback(error) or None, **where}
