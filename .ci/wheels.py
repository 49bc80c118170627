"""Builds the two wheels of a release into a folder: `rlctl-core`, which has the code, and `rlctl`, which has the rest.

`rlctl-core` requires what `check-env`, `eval` and `serve` need; `rlctl` requires it and all other dependencies. Both
come from pyproject.toml: `[tool.rlctl.core]` names what the first keeps. With a tag (`v0.1.0`) its version must be
that of the code. Usage: `python .ci/wheels.py FOLDER [TAG]`; needs hatchling.
"""

import copy
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

from hatchling.builders.wheel import WheelBuilder

ROOT = Path(__file__).parent.parent


def build(folder: str, tag: str | None = None) -> list[str]:
    """Build both wheels and return their paths; raises `SystemExit` if the tag is not that of the code's version."""
    whole = tomllib.loads((ROOT / "pyproject.toml").read_text())
    core = split(whole)
    builders = [WheelBuilder(str(ROOT), config=config) for config in (core, whole)]
    version = builders[0].metadata.version
    if tag is not None and tag != f"v{version}":
        raise SystemExit(f"the tag is {tag}, but rlctl/version.py has {version}: change it, or tag v{version}")
    whole["project"]["dependencies"].insert(0, f"rlctl-core=={version}")
    return [path for builder in builders for path in builder.build(directory=folder, versions=["standard"])]


def split(whole: dict[str, Any]) -> dict[str, Any]:
    """Move the code and its dependencies from the description of `rlctl` into that of `rlctl-core`; return that one."""
    core = copy.deepcopy(whole)
    chosen = whole["tool"]["rlctl"]["core"]
    project, rest = core["project"], whole["project"]
    lines = {_name(line): line for line in rest["dependencies"]}
    project["name"] = "rlctl-core"
    project["description"] += " Without the libraries that train, export and draw."
    project["dependencies"] = [lines[name] for name in chosen["dependencies"]]
    extras = project["optional-dependencies"]
    extras |= {extra: [lines[name] for name in names] for extra, names in chosen["extras"].items()}
    del extras["dev"], extras["docs"]
    rest["dependencies"] = [line for name, line in lines.items() if name not in chosen["dependencies"]]
    del rest["entry-points"], rest["optional-dependencies"]["dev"], rest["optional-dependencies"]["docs"]
    whole["tool"]["hatch"]["build"]["targets"]["wheel"] = {"bypass-selection": True, "exclude": ["*"]}
    return core


def _name(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9._-]", requirement, maxsplit=1)[0]


if __name__ == "__main__":
    print(*build(*sys.argv[1:3]), sep="\n")
