"""The connection to a Ray cluster, or to a Ray that is started on this machine."""

import atexit
import os
import secrets
import shutil
import socket
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rlctl.environments import registry
from rlctl.errors import TaskError, UsageError, explain_missing_package
from rlctl.rollout.workers import available_cores

_ASK_S, _GONE_S = 5.0, 30.0


def connect(address: str, task: str, cpus: int) -> Any:
    """Connect to Ray at an address, or start it on this machine if the address is empty; return the module `ray`.

    Nodes get a copy of the current folder if `is_copied(task)`. A Ray on this machine has at least `cpus` cores.
    Raises `UsageError` if Ray is not installed, and `TaskError` if it cannot be reached.
    """
    if (started := sys.modules.get("ray")) is not None and started.is_initialized():
        return started
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_DEDUP_LOGS", "0")
    if not address:
        # Without this Ray listens on all addresses of the machine, and writes a token into the home folder.
        folder = tempfile.mkdtemp(prefix="rlctl-ray-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)  # after Ray's own handler, which is registered later
        token = Path(folder) / "token"
        token.write_text(secrets.token_hex(32))  # only this user can read its folder
        os.environ |= {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_TMPDIR": folder}
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token)}
    try:
        import ray
    except ModuleNotFoundError as error:
        raise UsageError(explain_missing_package("--on ray", error.name, "cluster")) from None
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address:
        options["address"] = address
    else:
        options |= {"include_dashboard": False, "_node_ip_address": "127.0.0.1"}
        options["num_cpus"] = max(cpus, available_cores())
    if is_copied(task):
        options["runtime_env"] = {"working_dir": os.getcwd(), "excludes": ["/runs"]}
    try:
        ray.init(**options)
    except Exception as error:  # ConnectionError, ValueError or RuntimeError
        reason = str(error).partition("\n")[0]
        raise TaskError(f"--on ray:{address or 'local'}: cannot be reached: {reason}") from None
    return ray


class Pulse:
    """Raises an error if the cluster is lost; Ray itself would end this process after 60 s, without rlctl's message."""

    def __init__(self, ray: Any, hint: str = "") -> None:
        host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
        self._address, self._hint = (host, int(port)), hint
        self._asked_s = self._answered_s = time.monotonic()

    def check(self) -> None:
        """Connect to the cluster every few seconds; raise `TaskError` after `_GONE_S` without an answer."""
        if time.monotonic() - self._asked_s < _ASK_S:
            return
        self._asked_s = time.monotonic()
        try:
            socket.create_connection(self._address, _ASK_S).close()
            self._answered_s = time.monotonic()
        except OSError:
            if time.monotonic() - self._answered_s > _GONE_S:
                raise TaskError(f"--on ray: the cluster has not answered for {_GONE_S:g} s{self._hint}") from None


def is_copied(task: str) -> bool:
    """Return whether nodes get a copy of the current folder: the task is a file or module in it."""
    place = task.rpartition(":")[0]
    source = registry.find_source_file(task) if place and not Path(place).is_absolute() else None
    return source is not None and source.resolve().is_relative_to(Path.cwd())


def describe_slots(ray: Any, cpus: int, most: int) -> tuple[str, int]:
    """Return how many of `most` run at a time with `cpus` cores each: as text, and as a number."""
    cores = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    slots = min(most, sum(int(count // cpus) for count in cores))
    if not slots:
        return f"on Ray: waiting, because no machine has {cpus} cores (cpus in cluster.yaml)", 0
    return f"on Ray, {slots} at a time: {cpus} of its {sum(cores):g} cores each", slots
