"""Environments that promise pictures that they cannot make, open windows, have no time limit, or new spaces."""

import contextlib
import os

import numpy as np
from broken_envs import Clean
from gymnasium import spaces

with contextlib.suppress(ModuleNotFoundError):  # whatever needs it is skipped without it
    import pybullet


class RL404NewSpaces(Clean):
    def __init__(self):
        self.size = 5.0
        self.observation_space = spaces.Box(-5.0, 5.0, (2,), np.float32)

    @property
    def action_space(self):
        return spaces.Box(-1.0, 1.0, (2,), np.float32)


class FlagsPerAgent(Clean):
    """Returns the flags as dictionaries, as environments of many agents do."""

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, {"left": terminated}, {"left": truncated}, info


class Renders(Clean):
    """Draws the point: nothing is wrong with it."""

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 20}

    def __init__(self, render_mode=None):
        super().__init__()
        self.render_mode = render_mode

    def render(self):
        return str(self.position) if self.render_mode == "ansi" else self.draw()

    def draw(self):
        picture = np.zeros((20, 30, 3), np.uint8)
        picture[10, 15 + int(10 * self.position[0])] = 255
        return picture


class ResetRaises(Renders):
    def reset(self, *, seed=None, options=None):
        raise RuntimeError("no world")


class RL215TakesNoMode(Clean):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}


class RL215RenderRaises(Renders):
    def draw(self):
        raise RuntimeError("no camera")


class RL215RenderNeedsGraphics(Renders):
    def draw(self):
        raise RuntimeError("Cannot initialize a EGL device display")


class RL215RenderFloats(Renders):
    def draw(self):
        return super().draw() / 255


class RL215RenderNothing(Renders):
    def render(self):
        return None


class EndsInRender(Renders):
    def render(self):
        os._exit(9)


class RenderWithoutLibrary(Renders):
    def draw(self):
        import library_for_pictures  # noqa: F401


class RL216Gui(Clean):
    def __init__(self):
        super().__init__()
        self.client = pybullet.connect(pybullet.GUI)


class GuiInReset(Clean):
    def start(self):
        super().start()
        pybullet.connect(pybullet.GUI)


class DrawsInWindow(Renders):
    """Opens its window in reset, for "human" only: nothing is wrong with it."""

    def start(self):
        super().start()
        if self.render_mode == "human":
            self.open_window()

    def open_window(self):
        """Fails as pygame, Tk and pyglet do, which raise where there is no display."""
        raise RuntimeError("No available video device")


class WindowByDefault(DrawsInWindow):
    def __init__(self, render_mode="human"):
        super().__init__(render_mode)


class NoSuchDisplayException(Exception):
    """As of pyglet, whose message does not name the display."""


class WindowInConstructor(Renders):
    def __init__(self, render_mode="human"):
        super().__init__(render_mode)
        if render_mode == "human":
            raise NoSuchDisplayException('Cannot connect to "None"')


class ForgetsSeed(Clean):
    def reset(self, *, seed=None, options=None):
        return super().reset(options=options)


class CountsAsFlag(Clean):
    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, int(terminated), truncated, info


class RL506Falls(Clean):
    """Falls soon with bad actions, and never ends with good ones; nothing is ever truncated."""

    def move(self, action):
        super().move(3.0 * self.position + action)

    def reward(self):
        return float(np.exp(-np.linalg.norm(self.position)))

    def info(self):
        return {"is_success": self.steps > 8}

    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        terminated = bool(np.abs(self.position).max() > 4)
        return observation, reward, terminated, False, info


class RL506FallsInTime(RL506Falls):
    """The same with a limit, which random actions do not reach."""

    def step(self, action):
        observation, reward, terminated, _, info = super().step(action)
        truncated = self.steps >= 1000 and not terminated
        return observation, reward, terminated, truncated, info


class LacksOpenGL(Clean):
    """Draws what it observes, where there is no OpenGL."""

    def start(self):
        super().start()
        raise RuntimeError("an OpenGL platform library has not been loaded into this process")


class RaisesInStart(Clean):
    def start(self):
        super().start()
        raise RuntimeError("no licence")
