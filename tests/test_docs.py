"""The pages: links lead somewhere, commands exist with their options, and code runs."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import typer

from rlctl.environments.spec import EnvSpec
from rlctl.recipe import recipe
from rlctl.storage import yaml_text

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("docs/tutorial/*.md"), *ROOT.glob("examples/**/*.md")]
)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"`([^`\n]+)`")
NAMED_FILE = re.compile(r"`([\w.-]+)`:\n\n```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


OF_EXAMPLES = {"first-rewards"}  # commands of examples/, which are not installed


def of_pages(test):
    return pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))(test)


@dataclasses.dataclass(frozen=True)
class Block:
    """A block of code in a page."""

    page: Path
    language: str
    text: str
    line: int

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def find_blocks(language: str) -> list[Block]:
    found = []
    for page in PAGES:
        text = page.read_text()
        for match in FENCE.finditer(text):
            if match[1] == language:
                found.append(Block(page, language, match[2], text.count("\n", 0, match.start()) + 1))
    return found


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@of_pages
def test_links_lead_somewhere(page):
    for link in LINK.findall(FENCE.sub("", page.read_text())):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.name}: {link}"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link}"


def commands(page: Path) -> list[str]:
    """Return the rlctl commands of a page: lines of its unmarked blocks, and inline code."""
    text = page.read_text()
    lines = [line for match in FENCE.finditer(text) if match[1] == "" for line in match[2].splitlines()]
    found = [line.removeprefix("$ ") for line in lines] + CODE.findall(FENCE.sub("", text))
    return [re.split(r"\s+[#|] ", line)[0] for line in found if line.startswith("rlctl ")]


@functools.cache
def rlctl_command() -> Any:
    """Return the command that is made of all of them: it takes half a second."""
    from rlctl.cli import build_app, list_names

    return typer.main.get_command(build_app(list_names()))


def parse(words: list[str], command: Any = None) -> None:
    """Read a command line as rlctl does, and run nothing; raises what it raises for what does not exist."""
    command = command or rlctl_command()
    if not hasattr(command, "commands"):
        command.make_context(command.name, list(words))
    elif words and words[0].startswith("-"):
        assert words[0] in {option for each in command.params for option in each.opts} | {"--help"}
    elif words and words[0] not in OF_EXAMPLES:
        parse(words[1:], command.commands[words[0]])


@of_pages
def test_commands_exist_with_their_options(page):
    for command in commands(page):
        try:
            parse(shlex.split(command)[1:])
        except Exception as error:
            if "Missing parameter" not in str(error):  # a text may name a command without its arguments
                raise AssertionError(f"{command}: {error}") from error


def test_a_wrong_command_would_be_noticed():
    with pytest.raises(Exception, match="No such option"):
        parse(["train", "reach", "--speed", "3"])
    with pytest.raises(KeyError):
        parse(["tasks", "remove"])


@of_pages
def test_make_targets_exist(page):
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"^(?:\| `)?make ([\w-]+)", page.read_text(), re.MULTILINE)) <= targets


@pytest.mark.parametrize("block", find_blocks("python"), ids=str)
def test_python_is_python(block):
    compile(block.text, str(block), "exec")


def is_limits(block) -> bool:
    return block.text.startswith(("command:", "limits:"))


def is_mapping(block) -> bool:
    return block.text.startswith("observations:")


def is_deployment(block) -> bool:
    return "- kind: gyroscope" in block.text


OTHERS = (is_limits, is_mapping, is_deployment)
RECIPES = [each for each in find_blocks("yaml") if not any(is_other(each) for is_other in OTHERS)]


@pytest.mark.parametrize("block", RECIPES, ids=str)
def test_recipes_are_recipes(block):
    recipe.validate(yaml_text.load(block.text, str(block)), str(block))


def test_mappings_have_known_keys():
    from rlctl.exporting.controller.program_mapping import MappingFile

    (block,) = [each for each in find_blocks("yaml") if is_mapping(each)]
    MappingFile.model_validate(yaml_text.load(block.text, str(block)))


@pytest.mark.parametrize("block", [each for each in find_blocks("yaml") if is_deployment(each)], ids=str)
def test_deployments_are_complete_but_for_what_the_model_has(block):
    from rlctl.task.deployment import Deployment

    content = yaml_text.load(block.text, str(block))
    joints = list("abcdefghijkl")
    of_model = {"joints": joints, "stiffness": 35.0, "damping": 0.5, "default_positions": 0.0}
    values = {**of_model, **content, "start_height": 0.3}
    for name in ("stiffness", "damping", "default_positions", "action_scale", "target_speed"):
        if isinstance(values.get(name), float):
            values[name] = [values[name]] * len(joints)
    Deployment(**values)


def test_limits_are_limits_of_reach():
    from rlctl.deploy import Limits, SafetyFilter
    from rlctl.exporting.controller.plan import ControllerPlan
    from rlctl.exporting.controller.source import ControllerSource
    from rlctl.policy.file import PolicyFile
    from rlctl.policy.shipped import PRETRAINED
    from rlctl.runs.lookup import find_policy

    policy = PolicyFile.read(find_policy("reach", PRETRAINED).file)
    (block,) = [each for each in find_blocks("yaml") if is_limits(each) and "shoulder" not in each.text]
    limits = Limits.model_validate(yaml_text.load(block.text, str(block)))
    SafetyFilter(policy.info.env, limits)
    plan = ControllerPlan(policy.info.env, policy.info.spec.frame_stack)
    ControllerSource(policy, plan, "reach", limits)


def test_other_files_can_be_read():
    for block in find_blocks("toml"):
        tomllib.loads(block.text)
    for block in find_blocks("xml"):
        ElementTree.fromstring(block.text)
    assert set(re.findall(r"^```(\w+)$", "".join(page.read_text() for page in PAGES), re.MULTILINE)) <= {
        "python", "yaml", "toml", "xml", "cpp",
    }  # fmt: skip


def write_files(page: str, folder: Path) -> str:
    """Write the files that a page shows under their names; return the task that they define."""
    for name, _, text in NAMED_FILE.findall((ROOT / page).read_text()):
        (folder / name).write_text(text)
    (file,) = folder.glob("*.py")
    (cls,) = re.findall(r"^class (\w+)\(Task\)", file.read_text(), re.MULTILINE)
    return f"{file}:{cls}"


TASK_PAGES = ["README.md", "docs/task.md"]


@pytest.mark.parametrize("page", TASK_PAGES)
def test_tasks_of_the_pages_run(page, tmp_path):
    env = EnvSpec(write_files(page, tmp_path)).make()
    try:
        env.reset(seed=0)
        env.action_space.seed(0)
        for _ in range(20):
            _, _, terminated, truncated, info = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset(seed=1)
        assert "is_success" in info
    finally:
        env.close()


def test_the_event_of_the_page_on_tasks_is_accepted():
    (block,) = (each for each in find_blocks("python") if "def shift_base" in each.text)
    code: dict[str, Any] = {}
    exec(block.text, code)
    assert list(code["shift"].ranges) == ["sideways"]
    code["shift"].bind("shift")


@pytest.mark.slow
@pytest.mark.parametrize("page", TASK_PAGES)
def test_tasks_of_the_pages_are_sound_and_train(page, tmp_path, rlctl):
    task = write_files(page, tmp_path)
    checked = rlctl("check-env", task, "--strict", timeout=300)
    assert checked.returncode == 0, checked.stdout
    done = rlctl("train", task, "-n", "5000", "--set", "eval.episodes=4", timeout=300)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_worked_robot_learns(tmp_path, rlctl):
    task = write_files("docs/task.md", tmp_path)
    assert rlctl("train", task, timeout=1000).returncode == 0
    assert rlctl("eval", "Balance", "--min-success", "0.95", timeout=300).returncode == 0


def needs_run(block):
    return "runs/latest" in block.text or "rlctl.train(" in block.text


@pytest.mark.slow
def test_python_that_uses_a_run(tmp_path, rlctl, monkeypatch):
    small = ["--set", "eval.episodes=2", "--set", "algo_kwargs.n_steps=16", "--set", "algo_kwargs.batch_size=32"]
    assert rlctl("train", "reach", "-n", "64", "--n-envs", "4", *small, timeout=300).returncode == 0
    monkeypatch.chdir(tmp_path)
    blocks = [block for block in find_blocks("python") if needs_run(block)]
    assert blocks
    for block in blocks:
        exec(compile(block.text, str(block), "exec"), {})


@pytest.mark.slow
def test_python_that_needs_no_run():
    named = {text for page in PAGES for _, _, text in NAMED_FILE.findall(page.read_text())}
    blocks = [block for block in find_blocks("python") if block.text not in named and not needs_run(block)]
    blocks = [block for block in blocks if block.page.parent.name != "tutorial"]
    assert blocks
    for block in blocks:
        exec(compile(block.text, str(block), "exec"), {})


TUTORIAL = [f"docs/tutorial/{name}.md" for name in ("first-run", "own-robot", "compare", "deploy")]


def find_steps(page: str) -> list[str]:
    """Return the commands after `$ ` and the Python blocks of a page, in their order."""
    steps: list[str] = []
    for match in FENCE.finditer((ROOT / page).read_text()):
        if match[1] == "python":
            steps.append(match[2])
        elif match[1] == "":
            steps += re.findall(r"^\$ (rlctl (?!serve).*)$", match[2], re.MULTILINE)
    return steps


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_tutorial_works_from_the_first_page_to_the_last(tmp_path, rlctl, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (block,) = (block for block in find_blocks("yaml") if is_limits(block) and "elbow: {" in block.text)
    Path("limits.yaml").write_text(block.text)
    for step in [step for page in TUTORIAL for step in find_steps(page)]:
        if step.startswith("rlctl "):
            done = rlctl(*shlex.split(step)[1:], timeout=900)
            # The commands with a mistake on purpose.
            assert done.returncode == (1 if "tolerance=40" in step else 0), f"{step}\n{done.stdout}\n{done.stderr}"
        else:
            exec(compile(step, "tutorial", "exec"), {})


def section(page: str, heading: str) -> str:
    """Return a section of a page, up to the next heading of its level."""
    return re.split(r"^## ", (ROOT / page).read_text().partition(f"\n## {heading}\n")[2], flags=re.MULTILINE)[0]


def first_column(text: str) -> set[str]:
    """Return the names in the first column of the tables of a text."""
    cells = re.findall(r"^\| ([^|]*`[^|]*) \|", text, re.MULTILINE)
    return {re.match(r"\w+", code)[0] for cell in cells for code in CODE.findall(cell)}


def test_the_page_on_tasks_has_all_that_a_task_has():
    from rlctl.task import Body, Task, events, rewards
    from rlctl.task.task import TaskDefinition

    definition = {name for name in TaskDefinition.__annotations__ if name not in ("sim", "level")}
    assert first_column(section("docs/task.md", "The definition")) == definition
    methods = {
        name
        for name in {**vars(TaskDefinition), **vars(Task)}
        if not name.startswith("_") and callable(getattr(Task, name))
    }
    assert first_column(section("docs/task.md", "The methods")) == methods - {"parameters"}
    bodies = first_column(section("docs/task.md", "Bodies"))
    body = EnvSpec("reach").make().unwrapped.sim.body("arm")
    assert [name for name in bodies if not hasattr(body, name)] == []
    assert isinstance(body, Body)
    shown = set(CODE.findall(section("docs/task.md", "Rewards")))
    functions = {name for name in vars(rewards) if getattr(vars(rewards)[name], "__module__", "") == rewards.__name__}
    assert {name for name in functions if name.islower() and name[0] != "_"} <= shown
    shown = set(CODE.findall(section("docs/task.md", "Events: randomisation, pushes, noise, delay")))
    changes = "rlctl.task.events.changes"
    assert {name for name, value in vars(events).items() if getattr(value, "__module__", "") == changes} <= shown


def test_the_page_on_runs_has_every_file(tmp_path):
    from rlctl.runs.directory import RunDirectory

    run, table = RunDirectory(tmp_path), (ROOT / "docs/run.md").read_text().partition("\n## ")[0]
    for name in ("recipe_file", "status_file", "metrics_file", "evals_file", "best_policy", "last_policy", "onnx_file"):
        assert f"`{getattr(run, name).relative_to(tmp_path)}`" in table


def test_files_named_by_the_page_on_the_architecture_exist():
    text = (ROOT / "docs/architecture.md").read_text()
    paths = {code for code in CODE.findall(FENCE.sub("", text)) if re.fullmatch(r"[\w/]+(\.py|\.yaml|/)", code)}
    assert len(paths) > 60
    folders = (ROOT, ROOT / "rlctl", ROOT / "rlctl/task", ROOT / "rlctl/task/events")
    assert [path for path in paths if not any((folder / path).exists() for folder in folders)] == []


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 180


def load_generator(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_site_has_every_page_and_command(tmp_path, monkeypatch):
    make_site = load_generator("make_site")
    monkeypatch.setattr(make_site, "TARGET", tmp_path)
    make_site.write_pages()
    shown = re.findall(r": ([\w./-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert [page for page in shown if not (tmp_path / page).exists()] == []
    pages = [page for page in PAGES if page.relative_to(ROOT).parts[0] == "docs"]
    assert [page for page in pages if str(page.relative_to(ROOT / "docs")) not in shown] == []
    assert (tmp_path / "github" / "replay.png").exists()
    commands = re.findall(r"^## `rlctl ([\w-]+)`$", (tmp_path / "commands.md").read_text(), re.MULTILINE)
    assert set(commands) == set(rlctl_command().commands)


@pytest.mark.slow
def test_the_site_is_whole_and_loads_nothing_from_elsewhere():
    pytest.importorskip("zensical")
    load_generator("make_site").write_pages()
    subprocess.run(
        [sys.executable, "-m", "zensical", "build", "--strict", "--clean"], cwd=ROOT, check=True, timeout=200
    )
    pages = list((ROOT / "build" / "site").rglob("*.html"))
    assert len(pages) > 100
    loaded = re.compile(r"<(?:script|img|link|source)\b[^>]*?(?:src|href)=\"?([^\s\">#]+)")
    for page in pages:
        for address in loaded.findall(page.read_text()):
            local = page.parent / address if address[0] != "/" else ROOT / "build" / "site" / address[1:]
            assert local.exists(), f"{page.name} loads {address}"


@pytest.mark.pybullet
def test_pages_of_the_rules_are_current():
    make_rules = load_generator("make_rules")
    for file, text in make_rules.render_all(make_rules.read_printed()).items():
        assert file.read_text() == text, "run: python docs/make_rules.py"
