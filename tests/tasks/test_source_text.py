"""Starter plugins of robots whose names are hostile or odd: no name of a foreign file becomes code."""

import ast
import math
import re
import string
import tomllib
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
import yaml

from rlctl.tasks import hand_robot, legged_robot, motion_robot, new, source_text
from tests.tasks.test_new_walk import DOG, FEET, LEG, write_keyframe

HOSTILE = [
    'x");open("PWNED","w");("b',
    "'); open('PWNED', 'w'); ('b",
    '"""\nopen("PWNED", "w")\n"""',
    "two\nopen('PWNED', 'w')\rlines\x0c\x85\u2028",
    "ends in \\",
    "\\N{BULLET} \\x41 %s {0} $cls ${name} `code` | <b>*_[a](b)",
    "\U0001f916 \U0010ffff \ud83d caf\u00e9 \u202egnp",
    "key: [1, 2] # no comment",
    "",
]
NUMBERS = [0.5, -1e300, 1e-300, 0.0, math.inf, -math.inf, math.nan]
TEMPLATES = [new.TEMPLATE, legged_robot.TEMPLATE, hand_robot.TEMPLATE, motion_robot.TEMPLATE]
KINDS = [
    frozenset({"walk", "mirror", "mirror_walk", "origin", "drives", "pick", "one", "style", "style_walk"}),
    frozenset(
        {
            "clock",
            "aside",
            "mirror",
            "mirror_clock",
            "point",
            "mujoco",
            "motors",
            "place",
            "many",
            "style",
            "style_clock",
        }
    ),
]


def list_templates() -> list:
    """Each file of each template with each choice of its optional lines."""
    return [
        pytest.param(file, kept, id=f"{folder.name}/{file.name}-{'walk' if 'walk' in kept else 'clock'}")
        for folder in TEMPLATES
        for file in sorted(folder.rglob("*.tmpl"))
        for kept in KINDS
    ]


def fill(file: Path, kept: frozenset[str], text: str) -> str:
    """Return a template in which every placeholder has a text, except those of code and of checked names."""
    template = new._choose_lines(file.read_text(), kept)
    names = string.Template(template).get_identifiers()
    values = dict.fromkeys(names, text)
    values |= {name: source_text.SourceText(code) for name, code in CODE.items() if name in names}
    return source_text.fill_template(template, values, file.with_suffix("").suffix)


# What is code, or a checked name: their writers are tested below.
CODE = {
    "name": "my-arm",
    "package": "my_arm",
    "cls": "MyArm",
    "floor": "",
    "all_joints": "# Joints.",
    "model_in_readme": "`x`",
    "fixed": ", fixed=True",
    "axes": "[:2]",
    "steps_comment": "  # CHANGE",
    "armature_comment": "",
    "motor": '"sts3215"',
    "motor_comment": "# From a page.",
    "motor_values": "{}",
    "motor_events": '        "voltage": 1,',
    "motor_factors": '"events/backlash"',
    "inclined": " down",
    "towards_held": "+ 0",
    "both_sides": ", OTHER_SIDE",
}
CODE |= dict.fromkeys(
    (
        "joints",
        "tip_point",
        "start",
        "max_speed",
        "max_force",
        "pose",
        "pose_tip",
        "stance",
        "feet",
        "feet_in_order",
        "aside",
    ),
    "[0]",
)
CODE |= dict.fromkeys(("soles", "other_side", "mirror_vector", "mirror_turn", "mirror_command", "tip_to_goal"), "[0]")
CODE |= dict.fromkeys(("lowest", "highest"), "0.0, 1.0")
CODE |= dict.fromkeys(("arm", "gripper", "fingers", "open", "closed", "tip_down", "tip_side", "clips", "links"), "[0]")
CODE |= dict.fromkeys(("area_low", "area_high", "block_turn", "goal_heights"), "[0]")
CODE |= dict.fromkeys(("camera_eye", "camera_target", "wrist_eye", "wrist_up", "tip_tuple"), "(0, 0, 1)")
CODE |= dict.fromkeys(
    (
        *("start_noise", "tolerance", "smaller", "goal_range", "episode_s", "distance_weight", "clips_target", "reach"),
        *(
            "total_timesteps",
            "every_steps",
            "height",
            "fallen_height",
            "start_height",
            "stiffness",
            "damping",
            "period",
        ),
        *("armature", "gear_damping", "swing", "least_swing", "speed_scale", "turn_scale", "push", "bounce_weight"),
        *("sway_weight", "height_weight", "steps_up"),
        *("half", "width", "held", "scale", "lifted", "nearest", "noise", "released", "sag", "least_down"),
        *("size", "substeps", "farthest", "friction", "iterations"),
    ),
    "1",
)


def replace_strings(code: str, text: str) -> str:
    """Return the tree of Python code, in which `text` in strings is replaced by a plain word."""
    tree = ast.parse(code)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and text:
            node.value = node.value.replace(text, "plain")
    return ast.dump(tree)


def read_filled(filled: str, suffix: str, text: str) -> object:
    """Return the content of a filled template, in which `text` in the strings of Python is replaced by a plain word."""
    if suffix == ".py":
        return replace_strings(filled, text)
    if suffix == ".yaml":
        return yaml.safe_load(filled)
    if suffix == ".toml":
        return tomllib.loads(filled)
    return None


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("file", "kept"), list_templates())
def test_a_hostile_text_in_every_placeholder(file, kept):
    suffix = file.with_suffix("").suffix
    plain = fill(file, kept, "plain")
    content = read_filled(plain, suffix, "")
    for text in HOSTILE:
        filled = fill(file, kept, text)
        assert filled.count("\n") == plain.count("\n"), text
        if text or suffix != ".py":
            assert read_filled(filled, suffix, text) == content, text
        else:  # nothing marks its places in strings
            ast.parse(filled)


def test_every_placeholder_is_known_to_this_test():
    """A new placeholder is either quoted, as `test_a_hostile_text_in_every_placeholder` shows, or is in CODE."""
    quoted = {"model", "robot", "robot_phrase", "tip", "weight", "leg", "model_robot", "pose_comment", "start_comment"}
    quoted |= {"speed_comment", "force_comment", "stance_comment", "palm"}
    for folder in TEMPLATES:
        for file in folder.rglob("*.tmpl"):
            names = set(string.Template(file.read_text()).get_identifiers())
            assert names <= quoted | set(CODE)


@pytest.mark.parametrize("text", HOSTILE)
def test_strings_lists_and_comments(text):
    assert ast.literal_eval(source_text.write_string(text)) == text
    listed = source_text.write_list("JOINTS = ", [source_text.write_string(text)] * 9)
    assert ast.literal_eval(listed) == [text] * 9
    comment = source_text.write_comment(f"Of all joints: {text} {'and more ' * 30}")
    assert ast.dump(ast.parse(comment + "\n")) == ast.dump(ast.parse(""))
    # As YAML and TOML read what is between double quotes.
    if not re.search(r"[\ud800-\udfff]", text):
        assert yaml.safe_load(f'"{source_text.quote_text(text)}"') == text
        assert tomllib.loads(f'x = "{source_text.quote_text(text)}"') == {"x": text}


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("form", ["", "g", ".3f", ".2g"])
def test_numbers(number, form):
    value = eval(source_text.write_number(number, form), {"np": np})
    expected = number
    if math.isfinite(number):
        expected = float(format(number, form)) if form else round(number, 4)
    assert value == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize("text", HOSTILE)
def test_markdown(text):
    for quoted in (source_text.quote_markdown(text), source_text.quote_code_of_markdown(text)):
        assert not re.search(r"(?<!\\)\|", quoted)  # it stays in its cell of a table
        assert quoted.isprintable()
        assert len(quoted.encode().splitlines()) <= 1
    assert not re.search(r"(?<!\\)(\\\\)*[<*\[`]", source_text.quote_markdown(text))
    code = source_text.quote_code_of_markdown(text)
    fence = re.match("`+", code)[0]
    inside = code.removeprefix(fence).removesuffix(fence)
    assert fence not in re.findall("`+", inside)


def name_a_dog(folder: Path, name: str, *, free: bool) -> Path:
    """Write the dog of MJCF with hostile names of its file, joints, links and keyframe."""
    legs = "".join(LEG.format(leg=leg, x=x, y=y) for leg, (x, y) in zip(FEET, PLACES, strict=True))
    keyframe = write_keyframe("0 0.7 -1.4") if free else ""
    dog = DOG.format(free="<freejoint/>" if free else "", legs=legs, keyframe=keyframe)
    for word in ("front_left_hip", "neck", "head", "front_left_shank", "rear_right_shank", "home"):
        dog = dog.replace(f'"{word}"', quoteattr(f"{word} {name}"))
    file = folder / f"{name}.xml"
    file.write_text(dog, encoding="utf-8")
    return file


PLACES = [(x, y) for x in (0.15, -0.15) for y in (0.08, -0.08)]


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("walk", [False, True])
@pytest.mark.parametrize("name", ['x");open("PWNED","w");("b', 'a\'"""\n\U0001f916'])
def test_a_plugin_of_a_file_with_hostile_names(tmp_path, monkeypatch, name, walk):
    monkeypatch.chdir(tmp_path)
    file = name_a_dog(tmp_path, name, free=walk)
    plugin = new.create("odd-dog", model=file.name, walk=walk, link=None if walk else f"front_left_shank {name}")
    module = {"__file__": str((plugin.folder / "odd_dog" / "task.py").absolute()), "__name__": "task"}
    code = (plugin.folder / "odd_dog" / "task.py").read_text(encoding="utf-8")
    exec(compile(code, "task.py", "exec"), module)
    assert not Path("PWNED").exists()
    assert module["MODEL"].is_file()
    assert f"front_left_hip {name}" in module["JOINTS"]
    if not walk:
        assert module["TIP"] == f"front_left_shank {name}"
    for python in plugin.folder.rglob("*.py"):
        compile(python.read_text(encoding="utf-8"), python, "exec")
