"""The experiment `commands`: finds numbers of commands that reset draws and the observation shows, and changes them."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from rlctl.checking.command_sweeps import CommandSweep, sweep_command
from rlctl.checking.drawn_goals import DrawnGoal, DrawnPlace, Numbers
from rlctl.checking.experiment import PROBE, JudgeHook, experiment
from rlctl.checking.experiments.goals import find_copies, find_drawn
from rlctl.checking.goal_episodes import GoalEpisode, GoalTrials
from rlctl.checking.instance import Context, Instance
from rlctl.checking.records import FIRST_SEED, ChildMessage
from rlctl.checking.rule import NotApplicable, NotJudged
from rlctl.checking.term_names import split_name
from rlctl.checking.transitions import name_floats
from rlctl.checking.values import Attribute, is_task

COMMAND_WORDS = {"cmd", "cmds", "command", "commanded", "commands", "setpoint", "setpoints", "wanted"}
WISH_WORDS = {"desired", "ref", "reference", "target", "targets"}
MOTION_WORDS = {"height", "rate", "rates", "speed", "speeds", "turn", "vel", "velocities", "velocity", "yaw"}
"""What a wish is about that is paid in every step, and not only near a goal."""
OTHER_WORDS = {
    "angle", "attitude", "gait", "heading", "height", "joint", "joints", "mode", "phase", "pitch", "pose", "position",
    "roll",
}  # fmt: skip
"""What is commanded that is no velocity."""
MOST_NUMBERS = 32  # of an attribute: a plan has several commands
FIRST_STEPS, LATER_STEPS = 8, 3  # with the command that reset drew, and with another one
SEEDS = 4
SHIFTS = (-0.45, 0.2, 0.45)  # of a number of the command


@dataclasses.dataclass(frozen=True)
class CommandTrials:
    """An instance whose commands can be changed, and the numbers of them that reset draws and the observation shows."""

    instance: Instance
    paid: Sequence[DrawnPlace]  # Those that change a reward
    unpaid: Sequence[DrawnPlace]  # Those that change none
    sizes: Mapping[str, int]  # how many numbers each attribute has
    names: Sequence[str]  # of the observed numbers
    sweeps: dict[DrawnPlace, CommandSweep | None] = dataclasses.field(default_factory=dict)

    def sweep(self, place: DrawnPlace) -> CommandSweep | None:
        """Return what steps pay for many values of a number of a command; None where that is not known."""
        if place not in self.sweeps:
            self.sweeps[place] = sweep_command(self.instance, place)
        return self.sweeps[place]

    def name(self, place: DrawnPlace) -> str:
        """Name a number of a command: `self.command[1]`."""
        return f"{place.name}[{place.elements[0]}]" if self.sizes[place.name] > 1 else place.name

    def play(
        self, place: DrawnPlace, seed: int, change: Callable[[Numbers], Numbers], first: int = FIRST_STEPS
    ) -> list[float]:
        """Return the rewards of some steps with another command, which a function makes of that of reset; the robot has
        moved for the first steps. Empty if the episode ends before."""
        trials = GoalTrials(self.instance, DrawnGoal(place, (), (), {}, {}))
        episode = GoalEpisode(trials, seed, "repeated", first)
        if episode.has_ended:
            return []
        command = change(episode.goal)
        return [step.reward for step in episode.play([command] * LATER_STEPS)]

    def decides(self, place: DrawnPlace) -> bool | None:
        """Say whether a number of a command changes any reward; None where no episode lasts."""
        compared = 0
        for seed in range(FIRST_SEED, FIRST_SEED + SEEDS):
            plain = self.play(place, seed, lambda command: command)
            for shift in SHIFTS:
                changed = self.play(place, seed, functools.partial(np.add, shift))
                compared += min(len(plain), len(changed))
                if changed != plain:
                    return True
        return False if compared >= SEEDS * len(SHIFTS) else None


judges_commands = JudgeHook[CommandTrials]()
"""Shows an instance whose commands can be changed."""


@experiment("commands", PROBE, 111, share=0.3, hooks=(judges_commands,), seeds_globals=True, alters=True)
def change_commands(context: Context) -> Iterator[ChildMessage]:
    """Change each number of each command alone."""
    instance = context.instance
    if not instance.accepts_seed:
        raise NotJudged("reset takes no seed (RL202)")
    names = _name_elements(instance)
    found = find_drawn(instance, _list_numbers)
    paid: list[DrawnPlace] = []
    unpaid: list[DrawnPlace] = []
    trials = CommandTrials(instance, paid, unpaid, found.sizes, names)
    for places in found.stays.values():
        for place in places:
            if not _shows_command(instance, place, names):
                continue
            decides = trials.decides(place)
            if decides is not None:
                (paid if decides else unpaid).append(place)
            if context.budget.is_over():
                raise NotJudged("time ran out before all commands were changed")
    if not paid and not unpaid:
        raise NotApplicable("no command that reset draws is observed")
    yield from judges_commands.judge(trials)


def list_commands(instance: Instance) -> list[DrawnPlace]:
    """Return the commands that resets draw and the observation shows, with all of their numbers, one an attribute."""
    names = _name_elements(instance)
    found = find_drawn(instance, _list_numbers)
    commands = []
    for name, places in found.stays.items():
        shown = [place.elements[0] for place in places if _shows_command(instance, place, names)]
        commands += [DrawnPlace(name, tuple(shown))] if shown else []
    return commands


def _shows_command(instance: Instance, place: DrawnPlace, names: Sequence[str]) -> bool:
    """Say whether the observation shows a number, and the attribute or what it is observed as is called a command."""
    shown = [names[element] for element, _ in find_copies(instance, place)]
    return bool(shown) and any(_is_command(one) for one in (place.name, *shown))


def is_velocity(name: str) -> bool:
    """Say whether a command is one of a velocity by its name, or says not what it is."""
    return not {*split_name(name)} & OTHER_WORDS


def _name_elements(instance: Instance) -> list[str]:
    """Return the names of the observed numbers: those of a task have the names that it gives them."""
    names = name_floats(instance.leaves)
    sizes = dict(instance.env.unwrapped.observation_sizes) if is_task(instance.env) else {}
    own = [name for name, size in sizes.items() for _ in range(size)]
    return own if len(own) == len(names) else names


def _is_command(name: str) -> bool:
    words = set(split_name(name))
    return bool(words & COMMAND_WORDS or (words & WISH_WORDS and words & MOTION_WORDS))


def _list_numbers(one: Attribute, two: Attribute) -> list[DrawnPlace]:
    """Return each number that two resets drew differently."""
    size = one.numbers.size
    if np.asarray(one.value).dtype.kind != "f" or size != two.numbers.size or size > MOST_NUMBERS:
        return []
    return [DrawnPlace(one.name, (number,)) for number in np.flatnonzero(one.numbers != two.numbers).tolist()]
