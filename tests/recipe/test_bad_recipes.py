"""Recipes that cannot be: each ends with exit code 2, and three lines at most that name the key and what is right."""

import pytest

from rlctl.errors import RecipeError, UsageError
from rlctl.launching.train import run_training
from rlctl.recipe.sources import parse_settings, resolve
from rlctl.runs.train_request import TrainRequest

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 9)}]\n" for level in range(1, 10)
)
MERGE_BOMB = "a0: &a0 {k: 1}\n" + "".join(
    f"a{level}: &a{level}\n  !!merge <<: [{', '.join([f'*a{level - 1}'] * 9)}]\n" for level in range(1, 10)
)


def refused(config, settings=()):
    """The message with which a recipe is refused before anything is built."""
    with pytest.raises(RecipeError) as caught:
        resolve("Pendulum-v1", config, parse_settings(list(settings)))
    message = str(caught.value)
    assert caught.value.exit_code == 2
    assert len(message.splitlines()) <= 3
    assert len(message) < 500
    return message


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("n_envs: 1\nseed: 2\nn_envs: 3\n", ":3: key 'n_envs' is given twice"),
        ("n_envs:\t1\n", ":1: a tab: indent and separate with spaces"),
        ("n_envs: [1\n", ":2: expected ',' or ']', but got '<stream end>'"),
        ("n_envs: 1\n---\nn_envs: 2\n", ":2: expected a single document in the stream, but found another document"),
        ("- n_envs\n", ": expected a mapping of keys to values, got a list"),
        ("ppo\n", ": expected a mapping of keys to values, got a str"),
        ("7\n", ": expected a mapping of keys to values, got a int"),
        (BOMB, ":1: anchors and aliases (&name, *name) are not supported: write the values out"),
        (MERGE_BOMB, ":1: anchors and aliases (&name, *name) are not supported"),
        ("task: &a {b: *a}\n", ":1: anchors and aliases (&name, *name) are not supported"),
        ("task: *b\n", ":1: anchors and aliases (&name, *name) are not supported"),
        ("base: &b {n_envs: 1}\n<<: *b\n", ":1: anchors and aliases (&name, *name) are not supported"),
        ("n_envs: 1\n<<: {seed: 1}\n", ":2: no key '<<'."),
        ("task: " + "[" * 10_000 + "]" * 10_000, ": nested more than 50 deep"),
        ("task: " + "{a: " * 10_000 + "}" * 10_000, ": nested more than 50 deep"),
        ("task: " + "[" * 60 + "]" * 60, ":1: nested more than 50 deep"),
        ("- " * 10_000 + "a", ": nested more than 50 deep"),
        ("task: !!python/object/apply:os.system [touch pwned]\n", ":1: tags (!!int, !name) are not supported"),
        ("task: {a: !!binary aGk=}\n", ":1: tags (!!int, !name) are not supported: write the value alone"),
        ("n_envs: !!int many\n", ":1: tags (!!int, !name) are not supported"),
        ("task: ! x\n", ":1: tags (!!int, !name) are not supported"),
        (f"n_envs: {'9' * 10_000}\n", ":1: 9999"),
        (f"n_envs: 0x{'f' * 10_000}\n", ":1: 0xfff"),
        ("n_envs: 99999999999999999999\n", ":1: 99999999999999999999 is too large a number"),
        ("1: 2\n", ":1: 1 cannot be a key: keys are text, numbers in quotes"),
        ("true: 2\n", ":1: true cannot be a key"),
        ("null: 2\n", ":1: null cannot be a key"),
        ("[a, b]: 2\n", ":1: a list or a mapping cannot be a key"),
        ("task: a\0b\n", ": character 0x0 at 7 cannot be in YAML"),
        (b"\xff\xfet\x00a\x00s\x00k\x00", ": not UTF-8 text: invalid start byte at byte 0; save it as UTF-8"),
        ("n_envs: 1\n".encode("utf-16-be"), ": character 0x0 at 0 cannot be in YAML"),
        (b"task: {name: \xe9}\n", ": not UTF-8 text: invalid continuation byte at byte 13; save it as UTF-8"),
    ],
)
def test_a_file_that_is_no_recipe(content, expected, tmp_path):
    file = tmp_path / "recipe.yaml"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    message = refused(file)
    place, found, _ = message.partition(expected)
    assert found, message
    assert place.startswith(str(file))
    assert [each.name for each in tmp_path.iterdir()] == ["recipe.yaml"]


def test_what_looks_wrong_and_is_right(tmp_path):
    file = tmp_path / "recipe.yaml"
    file.write_text(
        "\ufefftotal_timesteps: 1e6\n"
        "algo_kwargs: {learning_rate: 3e-4, n_steps: 010, target_kl: null}\n"
        "task: {mode: on, time: 1:30}\n",
        encoding="utf-8",
    )
    recipe = resolve("Pendulum-v1", file, {})
    assert recipe.total_timesteps == 1_000_000
    assert recipe.algo_kwargs["learning_rate"] == 3e-4
    assert recipe.algo_kwargs["n_steps"] == 10
    assert recipe.task == {"mode": "on", "time": "1:30"}


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("n_envs=0", "n_envs: expected a whole number in [1, 10000], got 0"),
        ("n_envs=1e6", "n_envs: expected a whole number in [1, 10000], got 1000000.0"),
        ("n_envs='4'", "n_envs: expected a whole number in [1, 10000], got '4'"),
        ("n_envs=true", "n_envs: expected a whole number in [1, 10000], got True"),
        ("n_envs=.nan", "n_envs: expected a whole number in [1, 10000], got nan"),
        ("total_timesteps=0", "total_timesteps: expected a whole number in [1, 1e12], got 0"),
        (
            "total_timesteps=1e30",
            "total_timesteps: expected a whole number in [1, 1e12], got 1e+30",
        ),
        ("total_timesteps=-.inf", "total_timesteps: expected a whole number in [1, 1e12], got -inf"),
        ("seed=-1", "seed: expected a whole number in [0, 4294967296), got -1"),
        ("seed=1099511627776", "seed: expected a whole number in [0, 4294967296), got 1099511627776"),
        ("frame_stack=0", "frame_stack: expected a whole number in [1, 1000], got 0"),
        ("frame_stack=1e9", "frame_stack: expected a whole number in [1, 1000], got 1000000000.0"),
        ("randomize=yes", "randomize: expected true or false, got 'yes'"),
        ("randomize=1", "randomize: expected true or false, got 1"),
        ("stop_success=.inf", "stop_success: expected a number in (0, 1] or null, got inf"),
        ("stop_success='1'", "stop_success: expected a number in (0, 1] or null, got '1'"),
        ("eval=null", "eval: expected a mapping of every_steps, episodes, seed, deterministic, got None"),
        ("eval.episodes=0", "eval.episodes: expected a whole number in [1, 1e6], got 0"),
        ("eval.every_steps=0", "eval.every_steps: expected a whole number in [1, 1e12] or null, got 0"),
        ("checkpoint.keep=0", "checkpoint.keep: expected a whole number in [1, 1e6], got 0"),
        ("normalize.observation=1", "normalize.observation: expected true or false, got 1"),
        ("normalize.clip_reward=.inf", "normalize.clip_reward: expected a number > 0, got inf"),
        ("normalize.clip_observation=-1", "normalize.clip_observation: expected a number > 0, got -1"),
        ("reward_weights.a=.nan", "reward_weights.a: expected a number, got nan"),
        ("reward_weights.a=true", "reward_weights.a: expected a number, got True"),
        ("events.mass=3", "events.mass: expected a mapping, got 3"),
        ("task=3", "task: expected a mapping, got 3"),
        ("stages=3", "stages: expected a list, each element a mapping of task, reward_weights, events, level, pr"),
        ("stages=[{}, {}]", "stages: stage 1 of 2 (the recipe's own task) has no promotion rule"),
        (
            "stages=[{level: .nan}]",
            "stage 1: level: expected a number in [0, 1] or a mapping of start, up, down, got nan",
        ),
        ("stages=[{level: 2}]", "stage 1: level: expected a number in [0, 1] or a mapping of start, up, down, got 2"),
        ("stages=[{promote: {}}]", "stage 1: promote: give one of success and return"),
        (
            "stages=[{promote: {success: 0.5, window: 0}}]",
            "stage 1: promote.window: expected a whole number in [1, 1e6], got 0",
        ),
        (
            "stages=[{promote: {success: '0.5'}}]",
            "stage 1: promote.success: expected a number in (0, 1] or null, got '0.5'",
        ),
        (
            "algo=[ppo]",
            "algo: expected ppo or a2c or sac or td3 or ddpg or dqn or tqc or crossq or xqc or recurrent_",
        ),
        ("stage=[]", "no key 'stage'. Did you mean 'stages'? Keys here: "),
    ],
)
def test_values_that_cannot_be(setting, expected):
    message = refused(None, [setting])
    assert message.startswith(expected)


def test_a_key_that_never_ends():
    assert "write key=value, for example" in refused(None, ["task" + ".a" * 10_000 + "=1"])
    assert "write key=value, for example" in refused(None, ["task..a=1"])


def not_built(task, root, settings):
    """The message with which a recipe is refused when the model is to be built; no run is left behind."""
    with pytest.raises(UsageError) as caught:
        run_training(TrainRequest(task, settings=parse_settings(settings), root=root, check=False))
    assert caught.value.exit_code == 2
    assert not root.exists()
    message = str(caught.value)
    assert len(message.splitlines()) <= 3
    return message


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["algo=sac", "algo_kwargs.buffer_size=1e12"], "algo_kwargs.buffer_size: 1000000000000 needs 40.0 TB of "),
        (["algo_kwargs.n_steps=1e9"], "algo_kwargs.n_steps: 1000000000 needs 80.0 GB of memory, but only "),
        (["algo=dqn"], "dqn cannot be used here: "),
        (["policy_kwargs.squash_output=true"], "ppo cannot be used here: squash_output=True is only available when"),
    ],
)
def test_what_only_building_finds(settings, message, tmp_path):
    assert not_built("Pendulum-v1", tmp_path / "runs", ["n_envs=2", *settings]).startswith(message)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("task.tolerance='0.02'", "task.tolerance: expected a number, got '0.02'"),
        ("task.tolerance=true", "task.tolerance: expected a number, got True"),
        ("task.tolerance=.nan", "task.tolerance: expected a number, got nan"),
        ("task.tolerance=[1]", "task.tolerance: expected a number, got [1]"),
        ("task.tollerance=1", "task.tollerance: Reach has no parameter 'tollerance'. Did you mean 'tolerance'?"),
    ],
)
def test_parameters_of_a_task(setting, message, tmp_path):
    assert message in not_built("reach", tmp_path / "runs", ["n_envs=1", setting])


@pytest.mark.slow_except(first=3)
@pytest.mark.parametrize(
    "arguments",
    [
        ("-n", "1e30"),
        ("-n", "[[["),
        ("--seed", "-1"),
        ("--set", "algo_kwargs.gamma='0.99'"),
        ("--set", "task=!!python/object/apply:os.system [touch pwned]"),
        ("--num-envs", "1000000"),
        ("--algo", "{a: 1}"),
    ],
)
def test_the_command_ends_with_one_error(arguments, rlctl, tmp_path):
    done = rlctl("train", "Pendulum-v1", *arguments)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.splitlines()) <= 3
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []
