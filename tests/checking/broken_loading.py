"""Environments that cannot be built, or say the wrong things about themselves."""

import contextlib
import warnings

from broken_envs import Clean

with contextlib.suppress(ModuleNotFoundError):  # whatever needs it is skipped without it
    import pybullet
    import pybullet_data


class RL002Raising(Clean):
    def __init__(self):
        raise RuntimeError("no licence")


class UnreadableError(Exception):
    def __str__(self):
        raise RuntimeError("no text")


class WarnsWhereWarningsAreErrors(Clean):
    def __init__(self):
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # as a package does when it is imported
            warnings.warn("path is deprecated", DeprecationWarning, stacklevel=1)
        super().__init__()


class RL002RaisingUnreadably(Clean):
    def __init__(self):
        raise UnreadableError


class RaisingUnreadablyInStep(Clean):
    def step(self, action):
        raise UnreadableError


class RL002AnyAttribute(Clean):
    """Python expects AttributeError for a name that does not exist."""

    def __getattr__(self, name):
        return {}[name]


class RL002RaisingProperty(Clean):
    @property
    def sim(self):
        raise RuntimeError("not connected")


class RL002RaisingOfAnother(Clean):
    def __init__(self):
        try:
            import no_such_module_at_all  # noqa: F401
        except ImportError:
            raise RuntimeError("install the extra")  # noqa: B904


class RL002NeedsArgumentsInside(Clean):
    """The constructor's own call lacks an argument: nothing that a user can give."""

    def __init__(self):
        super().__init__()
        self.place()

    def place(self, link):
        pass


class RL006NeedsArguments(Clean):
    def __init__(self, gain, *, offset):
        super().__init__()


class RL007NoFile(Clean):
    def __init__(self):
        super().__init__()
        with open("gains.yaml") as file:
            self.gains = file.read()


class NoTable(Clean):
    def __init__(self):
        super().__init__()
        raise FileNotFoundError("data/table.csv not found.")


class RL007NoModel(Clean):
    """PyBullet says only that it cannot load, and searches in more than one folder."""

    model = "kuka_iiwa/modell.urdf"

    def __init__(self):
        super().__init__()
        self.client = pybullet.connect(pybullet.DIRECT)
        pybullet.setAdditionalSearchPath(pybullet_data.getDataPath(), physicsClientId=self.client)
        self.arm = pybullet.loadURDF(self.model, useFixedBase=True, physicsClientId=self.client)


class RL007NoModelAtReset(Clean):
    def __init__(self):
        super().__init__()
        self.client = pybullet.connect(pybullet.DIRECT)

    def start(self):
        super().start()
        pybullet.loadURDF("robot.urdf", physicsClientId=self.client)


class NoSearchPath(Clean):
    def __init__(self):
        super().__init__()
        self.client = pybullet.connect(pybullet.DIRECT)
        self.floor = pybullet.loadURDF("plane.urdf", physicsClientId=self.client)


class NoMujocoModel(Clean):
    def __init__(self):
        super().__init__()
        import mujoco  # optional

        self.model = mujoco.MjModel.from_xml_path("finger.xml")


class NoMujocoTexture(Clean):
    def __init__(self):
        import mujoco

        super().__init__()
        grass = '<texture name="grass" type="2d" file="assets/grass.png"/>'
        mujoco.MjModel.from_xml_string(f"<mujoco><asset>{grass}</asset></mujoco>")


class NoMujocoEnvModel(Clean):
    def __init__(self):
        from gymnasium.envs.mujoco import MujocoEnv  # optional

        MujocoEnv("/nowhere/arm.xml", 5, None)
