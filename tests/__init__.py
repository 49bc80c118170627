"""Tests; `HIDE_PACKAGES="pybullet pybullet_data" make test` runs them as if these packages were not installed."""

import os

if os.environ.get("HIDE_PACKAGES"):
    folder = os.path.join(os.path.dirname(__file__), "hidden")
    folders = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if folder not in folders:
        os.environ["PYTHONPATH"] = os.pathsep.join([folder, *filter(None, folders)])
        from tests.hidden import sitecustomize  # noqa: F401  # in this process; others find it in the path
