"""`rlctl tasks new`: writes a starter plugin that passes every check and trains in seconds."""

import dataclasses
import importlib.util
import keyword
import os
import re
from collections.abc import Sequence
from pathlib import Path

from rlctl.environments import installed
from rlctl.errors import UsageError
from rlctl.recipe.recipe import SCHEMA_FILE
from rlctl.storage import files as storage_files
from rlctl.task.clip_options import ClipOptions
from rlctl.tasks.asked_motors import AskedMotors
from rlctl.tasks.source_text import fill_template, quote_code_of_markdown
from rlctl.tasks.starter_robot import StarterRobot, make_planar_arm, read_robot

TEMPLATE = Path(__file__).with_name("template")
"""Templates of the files: `$name`, `$package`, `$cls` and the values of a `StarterRobot`; `package/` gets its name."""
_SUFFIX = ".tmpl"
_NAME = re.compile(r"[A-Za-z](?:[A-Za-z0-9_-]*[A-Za-z0-9])?")
_TAKEN = {
    "tests": "the plugin's folder of tests has that name",
    "latest": "`rlctl eval latest` means the newest run",
}


@dataclasses.dataclass(frozen=True)
class NewPlugin:
    """A plugin that was written."""

    name: str
    folder: Path
    package: str
    cls: str
    files: list[Path]  # relative to `folder`
    summary: str
    follows: bool = False
    """Whether it follows clips, so that `--policy reference` shows them."""

    @property
    def target(self) -> str:
        """The task's name while it is not installed."""
        return f"{self.folder / self.package / 'task.py'}:{self.cls}"


@dataclasses.dataclass(frozen=True)
class AskedRobot:
    """A user's own robot, and what it is to do."""

    model: str | None = None
    """A URDF or MJCF file; None for a planar arm."""
    link: str | None = None
    """The link that reaches."""
    walk: bool = False
    hand: tuple[str, ...] = ()
    """Of pick, place and push those that were asked for."""
    gripper: str | None = None
    """A joint of the gripper of a hand."""
    tip: str | None = None
    """The link whose origin is between the fingers of a hand."""
    motors: AskedMotors | None = None
    motions: tuple[str, ...] = ()
    """Clips that it follows, or in whose style it walks."""
    clip: ClipOptions = ClipOptions()  # noqa: RUF009 (it cannot change)
    """What a user says of the clips."""

    @property
    def follows(self) -> bool:
        """Whether it follows clips; a robot that walks only moves like them."""
        return bool(self.motions) and not self.walk

    def check(self) -> None:
        """Raise `UsageError` for options that exclude each other, or need another one."""
        kinds = [*(["walk"] if self.walk else []), *self.hand, *(["motion"] if self.follows else [])]
        if len(kinds) > 1:
            raise UsageError(f"{' and '.join(f'--{kind}' for kind in kinds)} exclude each other: a task has one aim")
        chosen = {"link": self.link, "gripper": self.gripper, "tip": self.tip, "motors": self.motors}
        given = [
            *kinds,
            *(["motion"] if self.motions else []),
            *(name for name, value in chosen.items() if value is not None),
        ]
        if self.model is None and given:
            raise UsageError(f"--{given[0]} needs --model")
        if kinds and self.link is not None:
            raise UsageError(f"--{kinds[0]} and --link exclude each other: --link is the tip of an arm that reaches")
        if self.follows and self.motors is not None:
            raise UsageError("--motors and --motion exclude each other: call set_motors in the task's build instead")
        if not self.motions and self.clip != ClipOptions():
            raise UsageError("--rate, --quaternion, --clip-joints and --frames need --motion")
        for name in ("gripper", "tip"):
            if chosen[name] is not None and not self.hand:
                raise UsageError(f"--{name} needs --pick, --place or --push")


def create(
    name: str,
    *,
    model: str | None = None,
    link: str | None = None,
    walk: bool = False,
    hand: Sequence[str] = (),
    gripper: str | None = None,
    tip: str | None = None,
    motors: str | None = None,
    backlash: str | None = None,
    motions: Sequence[str] = (),
    clip: ClipOptions = ClipOptions(),  # noqa: B008 (it cannot change)
) -> NewPlugin:
    """Write the plugin `name` atomically into the current folder, of an `AskedRobot`, whose attributes the others are.

    `motors` names one of `rlctl.task.named_motors`, `backlash` is an angle such as `1deg`.

    Raises `UsageError` for a name in use, for options that do not fit together, and for a model that is missing, or
    cannot do what is asked.
    """
    real = AskedMotors.read(motors, backlash)
    asked = AskedRobot(model, link, walk, tuple(hand), gripper, tip, real, tuple(motions), clip)
    asked.check()
    package = name.replace("-", "_").lower()
    _check(name, package)
    folder = Path(name)
    if os.path.lexists(folder):
        raise UsageError(f"{folder} already exists; choose another name or another folder")
    robot = _read_robot(asked)
    sources = _read_templates(TEMPLATE) | (_read_templates(robot.template) if robot.template else {})
    cls = _make_class_name(name, "".join(sources.values()))
    model_in_readme = quote_code_of_markdown(f"{package}/{robot.values['model']}")
    values = {**robot.values, "name": name, "package": package, "cls": cls, "model_in_readme": model_in_readme}
    content: dict[Path, bytes] = {}
    for path, text in sources.items():
        place = Path(*(package if part == "package" else part for part in path.parts))
        content[place] = fill_template(_choose_lines(text, robot.kept), values, path.suffix).encode()
    content |= {package / path: data for path, data in robot.files.items()}
    # The recipe's schema is copied next to it, since a path to this machine's packages is wrong on other machines.
    content[Path(package, SCHEMA_FILE.name)] = SCHEMA_FILE.read_bytes()
    with storage_files.whole_folder(folder) as temporary:
        for path, data in content.items():
            (temporary / path).parent.mkdir(parents=True, exist_ok=True)
            storage_files.write_new(temporary / path, data)
    return NewPlugin(name, folder, package, cls, sorted(content), robot.summary, follows=asked.follows)


def _read_robot(asked: AskedRobot) -> StarterRobot:
    if asked.model is None:
        return make_planar_arm()
    if asked.walk:
        from rlctl.tasks.legged_robot import read_legged_robot  # it loads NumPy

        return read_legged_robot(asked.model, asked.motors, asked.motions, asked.clip)
    if asked.motions:
        from rlctl.tasks.motion_robot import read_motion_robot

        return read_motion_robot(asked.model, asked.motions, asked.clip)
    if asked.hand:
        from rlctl.tasks.hand_robot import read_hand_robot

        return read_hand_robot(asked.model, asked.hand[0], gripper=asked.gripper, tip=asked.tip, asked=asked.motors)
    return read_robot(asked.model, asked.link, asked.motors)


def _choose_lines(text: str, kept: frozenset[str]) -> str:
    """Return the text of a template without the lines that begin with ?NAME: of other names than `kept`."""
    return re.sub(r"^\?(\w+):(.*\n)", lambda line: line[2] if line[1] in kept else "", text, flags=re.MULTILINE)


def _read_templates(folder: Path) -> dict[Path, str]:
    files = sorted(folder.rglob(f"*{_SUFFIX}"))
    return {file.relative_to(folder).with_suffix(""): file.read_text(encoding="utf-8") for file in files}


def show(plugin: NewPlugin, json: str | None) -> None:
    """Print the files and the next commands, or only JSON for `-`."""
    from rlctl import output

    files = [str(plugin.folder / file) for file in plugin.files]
    content = {"name": plugin.name, "folder": str(plugin.folder), "target": plugin.target, "files": files}
    if output.present(content, json):
        return
    out = output.out()
    for file in plugin.files:
        out.print(f"wrote {plugin.folder / file}")
    out.print(f"{plugin.summary}.")
    out.print("next:")
    first = "reference" if plugin.follows else "zero"
    for command in (
        f"rlctl replay {plugin.target} --policy {first}",
        f"rlctl check-env {plugin.target}",
        f'pip install -e "{plugin.folder}[test]"',
        f"rlctl train {plugin.name}",
        f"pytest {plugin.folder}",
    ):
        out.print(f"  {command}")


def _check(name: str, package: str) -> None:
    if not _NAME.fullmatch(name):
        near = re.sub(r"[^A-Za-z0-9_]+", "-", name).strip("-_0123456789")
        raise UsageError(
            f"name {name!r}: use letters, digits, - and _; begin with a letter, end with a letter or digit"
            f"{f', such as {near!r}' if _NAME.fullmatch(near) else ''}"
        )
    if entry := installed.find(name):
        raise UsageError(
            f"task {name!r} of {entry.distribution} {entry.version} is already installed; choose another name"
        )
    if reason := _TAKEN.get(package):
        raise UsageError(f"name {name!r}: {reason}; choose another name")
    if keyword.iskeyword(package):
        raise UsageError(f"name {name!r}: {package} is a Python keyword; choose another name")
    # The installed plugin would hide that module.
    spec = importlib.util.find_spec(package)
    if spec is not None and spec.origin is not None:  # without an origin it is only a folder on the path
        raise UsageError(f"name {name!r}: module {package!r} already exists ({spec.origin}); choose another name")


def _make_class_name(name: str, used: str) -> str:
    """`my-arm` -> `MyArm`; `MyArmTask` if the template or Python already uses that word."""
    cls = "".join(part[:1].upper() + part[1:] for part in re.split("[-_]+", name))
    return f"{cls}Task" if keyword.iskeyword(cls) or re.search(rf"\b{cls}\b", used) else cls
