"""The connection to a Ray cluster, or to a Ray that is started on this machine."""

from __future__ import annotations

import atexit
import os
import secrets
import shutil
import tempfile
from pathlib import Path
from typing import Any

from rlctl.errors import TaskError, UsageError, explain_missing_package


def connect(address: str) -> Any:
    """Connect to Ray at an address, or start it on this machine if the address is empty; return the module `ray`.

    Raises `UsageError` if Ray is not installed, and `TaskError` if it cannot be reached.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_DEDUP_LOGS", "0")
    if not address:
        # Without this Ray listens on all addresses of the machine, and writes a token into the home folder.
        folder = tempfile.mkdtemp(prefix="rlctl-ray-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)  # after Ray's own handler, which is registered later
        token = Path(folder) / "token"
        token.write_text(secrets.token_hex(32))  # its folder is this user's alone
        os.environ.update(
            {
                "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
                "RAY_TMPDIR": folder,
                "RAY_AUTH_MODE": "token",
                "RAY_AUTH_TOKEN_PATH": str(token),
            }
        )
    try:
        import ray
    except ModuleNotFoundError as error:
        raise UsageError(explain_missing_package("--on ray", error.name, "cluster")) from None
    if ray.is_initialized():
        return ray
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    options |= {"address": address} if address else {"include_dashboard": False, "_node_ip_address": "127.0.0.1"}
    try:
        ray.init(**options)
    except Exception as error:  # ConnectionError, ValueError or RuntimeError
        raise TaskError(
            f"--on ray:{address or 'local'}: cannot be reached: {str(error).partition(chr(10))[0]}"
        ) from None
    return ray
