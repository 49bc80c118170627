"""Registers every installed task with Gymnasium when imported; no plugin is imported.

`gymnasium.make("rlctl.gym:rlctl/reach-v0")`, or `--gym-packages rlctl.gym` in other tools.
"""

import gymnasium

from rlctl.environments import installed

for _entry in installed.list_installed():
    if _entry.problem is None:
        gymnasium.register(
            id=f"rlctl/{_entry.name}-v0",
            entry_point="rlctl.api:make",
            kwargs={"task": _entry.name},
            disable_env_checker=True,
        )
