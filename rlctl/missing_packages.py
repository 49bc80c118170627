"""What to install or to change for a module that is missing: many packages have another name than their module."""

import re
import shlex
import traceback
from pathlib import Path

_PACKAGES = {
    "Box2D": "gymnasium[box2d]",
    "Crypto": "pycryptodome",
    "OpenGL": "PyOpenGL",
    "PIL": "Pillow",
    "absl": "absl-py",
    "ale_py": "gymnasium[atari]",
    "attr": "attrs",
    "bs4": "beautifulsoup4",
    "can": "python-can",
    "cv2": "opencv-python",
    "dateutil": "python-dateutil",
    "distutils": "setuptools<81",
    "dm_control": "dm-control",
    "dotenv": "python-dotenv",
    "fcl": "python-fcl",
    "git": "GitPython",
    "gymnasium_robotics": "gymnasium-robotics",
    "highway_env": "highway-env",
    "hydra": "hydra-core",
    "igl": "libigl",
    "mpl_toolkits": "matplotlib",
    "panda_gym": "panda-gym",
    "pinocchio": "pin",
    "pkg_resources": "setuptools<81",
    "pybullet_data": "pybullet",
    "pybullet_envs_gymnasium": "pybullet-envs-gymnasium",
    "pybullet_utils": "pybullet",
    "pylab": "matplotlib",
    "quaternion": "numpy-quaternion",
    "rerun": "rerun-sdk",
    "robot_descriptions": "robot-descriptions",
    "rsl_rl": "rsl-rl-lib",
    "ruamel": "ruamel.yaml",
    "sb3_contrib": "sb3-contrib",
    "serial": "pyserial",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "stable_baselines3": "stable-baselines3",
    "urdf_parser_py": "urdf-parser-py",
    "usb": "pyusb",
    "yaml": "PyYAML",
    "zmq": "pyzmq",
}
"""The package by its module, where pip knows it by another name."""
_REPLACED = {
    "d4rl": "d4rl needs the old gym; its data sets for Gymnasium are in Minari: pip install minari",
    "gym": "gym is the old Gymnasium: write `import gymnasium as gym`, register with gymnasium.register; "
    "reset returns (observation, info), step five values",
    "gym_minigrid": "gym_minigrid needs the old gym; its successor: pip install minigrid",
    "mujoco_py": "mujoco_py is the old MuJoCo: pip install mujoco, and use environments of v4 or later, such as Ant-v5",
    "pybullet_envs": "pybullet_envs needs the old gym; for Gymnasium: pip install pybullet-envs-gymnasium, "
    "and name pybullet_envs_gymnasium:AntBulletEnv-v0, for example",
    "rclpy": "rclpy comes with ROS 2, not with pip: source its setup.bash first",
    "rospy": "rospy comes with ROS, not with pip: source its setup.bash first",
}
"""What works today, by a module that pip cannot install, or not for Gymnasium."""
_LIBRARIES = {"libGL.so": "pip uninstall opencv-python; pip install opencv-python-headless, which needs no display"}
"""What to do where a shared library of the system is missing."""


def advise(error: BaseException | None) -> str:
    """Return "; " and what to install for a module that an exception, or one behind it, misses; empty if unknown."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and (advice := advise_on(error.name or "", _find_importer(error))):
            return advice
        if isinstance(error, ImportError):
            for library, advice in _LIBRARIES.items():
                if library in str(error):
                    return f"; {advice}"
        error = error.__cause__ or error.__context__
    return ""


def advise_on(module: str, importer: str = "") -> str:
    """Return "; " and what to install for a module, which the package `importer` imports; empty if unknown."""
    package = module.partition(".")[0]
    if replaced := _REPLACED.get(importer) or _REPLACED.get(package):
        return f"; {replaced}"
    return f"; pip install {shlex.quote(_PACKAGES[package])}" if package in _PACKAGES else ""


def name_package(module: str) -> str:
    """Return the name by which pip knows a module's package."""
    package = module.partition(".")[0]
    return _PACKAGES.get(package, package)


def split(message: str, error: BaseException | None) -> tuple[str, str]:
    """Return a message without its advice, and the advice alone, which may be empty."""
    advice = advise(error)
    return message.removesuffix(advice), advice.removeprefix("; ")


def _find_importer(error: ModuleNotFoundError) -> str:
    """Return the installed package whose file imports the missing module; empty if it is a user's own file."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith("<frozen")]
    installed = re.search(r"(?:site|dist)-packages/(\w+)", Path(frames[-1].filename).as_posix()) if frames else None
    return installed[1] if installed else ""
