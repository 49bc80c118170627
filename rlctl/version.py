"""The version of rlctl, the folder it is installed in, and the versions that a result depends on."""

import functools
from pathlib import Path

__version__ = "0.1.0"
PACKAGE_FOLDER = Path(__file__).parent


def collect_versions() -> dict[str, str]:
    """Return the versions that a result depends on: Python's, rlctl's and those of libraries that are installed."""
    return dict(_read_versions())


@functools.cache  # each is read from a file, and every checkpoint needs them
def _read_versions() -> dict[str, str]:
    import platform
    from importlib.metadata import PackageNotFoundError, distribution

    versions = {"python": platform.python_version(), "rlctl": __version__}
    for library in ("torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy", "pybullet", "mujoco"):
        try:
            installed = distribution(library)
        except PackageNotFoundError:
            continue
        versions[library] = installed.version
        if library == "pybullet":  # a wheel and a build from source differ in the last bits of a simulation
            tags = [line.removeprefix("Tag: ") for line in (installed.read_text("WHEEL") or "").splitlines()]
            versions["pybullet build"] = next((tag for tag in tags if tag.startswith("cp")), "unknown")
    return versions
