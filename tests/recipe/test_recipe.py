"""Recipes: where a value comes from, and what is said of one that cannot be."""

import math

import numpy as np
import pytest

from rlctl.environments.spec import UNCHANGED, EnvChanges, EnvSpec
from rlctl.errors import ArtifactError, RecipeError, RlctlError
from rlctl.recipe import recipe, sources
from rlctl.recipe.recipe import Recipe, validate
from rlctl.recipe.sources import parse_changes, parse_settings, resolve


@pytest.fixture
def packaged(tmp_path):
    """A task by path with a recipe beside it; only the recipe is read."""
    (tmp_path / "my_env.py").write_text("class MyEnv: ...")
    (tmp_path / "my_env.yaml").write_text(
        "algo: ppo\n"
        "algo_kwargs: {learning_rate: 1e-3, n_steps: 100, gamma: 0.9}\n"
        "policy_kwargs: {net_arch: [32]}\n"
        "task: {size: 3, shape: round}\n"
        "n_envs: 64\n"
        "total_timesteps: 200_000\n"
    )
    return f"{tmp_path / 'my_env.py'}:MyEnv"


@pytest.fixture
def config(tmp_path):
    def write(text):
        file = tmp_path / "config.yaml"
        file.write_text(text)
        return file

    return write


def test_set_goes_over_config_goes_over_packaged(packaged, config):
    file = config("algo_kwargs: {gamma: 0.95, n_steps: 50}\ntask: {size: 4}\n")
    settings = parse_settings(["algo_kwargs.gamma=0.99", "task.colour=red"])
    result = resolve(packaged, file, settings)
    assert result.algo_kwargs["learning_rate"] == 1e-3  # packaged
    assert result.algo_kwargs["n_steps"] == 50  # config
    assert result.algo_kwargs["gamma"] == 0.99  # --set
    assert result.task == {"size": 4, "shape": "round", "colour": "red"}
    assert result.n_envs == 64


def test_another_algorithm_takes_nothing_of_the_packaged_ones(packaged):
    result = resolve(packaged, None, {"algo": "sac", "algo_kwargs": {"gamma": 0.98}})
    assert result.algo_kwargs == {"gamma": 0.98, "gradient_steps": -1, "train_freq": 1, "buffer_size": 200_000}
    assert result.policy_kwargs == {}
    assert result.task == {"size": 3, "shape": "round"}  # of the task, not of the algorithm
    assert not result.normalize.observation


def test_algorithms_are_compared_with_equal_environments_and_steps(packaged, config):
    result = resolve(packaged, None, {"algo": "sac"})
    assert (result.n_envs, result.total_timesteps) == (64, 200_000)
    file = config("algo: ppo\nalgo_kwargs: {n_steps: 50}\nnormalize: {reward: true}\nn_envs: 4\n")
    result = resolve(packaged, file, {"algo": "sac"})
    assert (result.n_envs, result.total_timesteps) == (4, 200_000)
    assert "n_steps" not in result.algo_kwargs  # --algo takes nothing of a --config for another algorithm either
    assert not result.normalize.reward


def test_a_config_without_an_algorithm_is_for_the_chosen_one(packaged, config):
    file = config("algo_kwargs: {tau: 0.01}\n")
    assert resolve(packaged, file, {"algo": "sac"}).algo_kwargs["tau"] == 0.01


def test_keys_that_the_chosen_algorithm_does_not_have_are_left_out(packaged, tmp_path):
    (tmp_path / "my_env.yaml").write_text("algo: ppo\nprivileged: {}\nmirror: true\nmirror_loss: 0.5\n")
    assert resolve(packaged, None, {"algo": "sac"}).privileged is not None
    td3 = resolve(packaged, None, {"algo": "td3"})
    assert (td3.privileged, td3.mirror, td3.mirror_loss) == (None, False, 0.0)


def test_a_line_for_what_does_not_carry_over(packaged, config):
    own = packaged.replace(".py:MyEnv", ".yaml")
    assert sources.describe_other_algorithm(packaged, None, {}) == []
    assert sources.describe_other_algorithm(packaged, None, {"algo": "sac", "n_envs": 2}) == [
        f"{own} is for ppo; not used for sac: algo_kwargs, policy_kwargs; used: total_timesteps 200000"
    ]
    file = config("algo: ppo\nher: null\nn_envs: 4\ntotal_timesteps: 10\n")
    assert sources.describe_other_algorithm(packaged, file, {"algo": "a2c"}) == [
        f"{file} is for ppo; not used for a2c: her; used: n_envs 4, total_timesteps 10",
        f"{own} is for ppo; not used for a2c: algo_kwargs, policy_kwargs",
    ]


def test_another_algorithm_takes_no_hindsight_of_the_packaged_one(packaged, tmp_path):
    (tmp_path / "my_env.yaml").write_text("algo: sac\nher: {n_sampled_goal: 2}\n")
    assert resolve(packaged, None, {}).her == recipe.Hindsight(n_sampled_goal=2, goal_selection_strategy="future")
    assert resolve(packaged, None, parse_settings(["her=null"])).her is None
    assert resolve(packaged, None, {"algo": "ppo"}).her is None
    assert resolve(packaged, None, {"algo": "td3"}).her is None
    assert resolve(packaged, None, {"algo": "td3", "her": {}}).her == recipe.Hindsight()


def test_the_same_algorithm_named_again_keeps_them(packaged):
    assert resolve(packaged, None, {"algo": "ppo"}).algo_kwargs["n_steps"] == 100


def test_defaults_for_an_environment_without_a_recipe():
    result = resolve("Pendulum-v1", None, {})
    assert (result.algo, result.n_envs) == ("ppo", 8)
    assert 2048 <= result.algo_kwargs["n_steps"] * result.n_envs <= 16_384
    assert result.normalize == recipe.NormalizeSettings()
    assert result.eval.every_steps == result.total_timesteps // 10


def test_every_packaged_recipe_is_valid():
    from rlctl.environments import installed

    for entry in installed.list_installed():
        if entry.distribution == "rlctl":
            assert entry.recipe_file is not None, entry.name
            assert isinstance(resolve(entry.name, None, {}), Recipe)


def test_a_resolved_recipe_is_a_config(packaged, config):
    first = resolve(packaged, None, parse_settings(["task.name=1e6", "stop_success=0.98", "algo_kwargs.ent_coef=1e-5"]))
    again = resolve("other.py:Env", config(first.to_yaml()), {})
    assert again == first
    assert again.task["name"] == 1e6
    text = validate({"task": {"name": "1e6"}}, "x")
    assert resolve("other.py:Env", config(text.to_yaml()), {}).task == {"name": "1e6"}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"alog": "ppo"}, "no key 'alog'. Did you mean 'algo'? Keys here: task, reward_weights, "),
        ({"tolerance": 0.02}, "no key 'tolerance'. Did you mean 'task.tolerance'? Keys here: task, "),
        ({"gamma": 0.9}, "no key 'gamma'. Did you mean 'algo_kwargs.gamma'? Keys here: task, "),
        ({"gama": 0.9}, "no key 'gama'. Did you mean 'algo_kwargs.gamma'? Keys here: task, "),
        (
            {"eval": {"episode": 3}},
            "no key 'eval.episode'. Did you mean 'episodes'? Keys here: every_steps, episodes, seed, deterministic.",
        ),
        ({"checkpoint": {"kep": 3}}, "no key 'checkpoint.kep'. Did you mean 'keep'? Keys here: keep."),
        (
            {"algo": "sac", "her": {"n_sampled_goals": 3}},
            "no key 'her.n_sampled_goals'. Did you mean 'n_sampled_goal'? Keys here: n_sampled_goal, "
            "goal_selection_strategy.",
        ),
        ({"algo": "sac", "her": {"n_sampled_goal": 0}}, "her.n_sampled_goal: expected a whole number in [1, 1000]"),
        (
            {"algo": "sac", "her": {"goal_selection_strategy": "past"}},
            "her.goal_selection_strategy: expected future or final or episode, got 'past'",
        ),
        ({"her": {}}, "her: ppo does not support hindsight replay; sac, td3, ddpg, dqn, tqc, xqc do"),
        (
            {"algo": "crossq", "her": {}},
            "her: crossq does not support hindsight replay; sac, td3, ddpg, dqn, tqc, xqc",
        ),
        ({"algo": "sacc", "her": {}}, "algo: expected ppo or a2c or sac or td3 or ddpg or dqn or tqc or crossq or"),
        ({"n_envs": "many"}, "n_envs: expected a whole number in [1, 10000], got 'many'"),
        ({"n_envs": 0}, "n_envs: expected a whole number in [1, 10000], got 0"),
        ({"task": 3}, "task: expected a mapping, got 3"),
        ({"total_timesteps": 1.5}, "total_timesteps: expected a whole number in [1, 1e12], got 1.5"),
        ({"stop_success": 2}, "stop_success: expected a number in (0, 1] or null, got 2"),
        ({"seed": -1}, "seed: expected a whole number in [0, 4294967296), got -1"),
        ({"reward_weights": {"a": math.nan}}, "reward_weights.a: expected a number, got nan"),
        ({"algo": "pppo"}, "algo: expected ppo or a2c or sac or td3 or ddpg or dqn or tqc or crossq or xqc or recu"),
        ({"algo_kwargs": {"learning_rate": 3}}, "algo_kwargs.learning_rate: expected a number in (0, 1] or lin_NU"),
        ({"algo_kwargs": {"learning_rate": math.nan}}, "algo_kwargs.learning_rate: expected a number in (0, 1] or"),
        ({"algo_kwargs": {"gamma": 99}}, "algo_kwargs.gamma: expected a number in (0, 1], got 99"),
        ({"algo_kwargs": {"gamma": "0.99"}}, "algo_kwargs.gamma: expected a number in (0, 1], got '0.99'"),
        ({"algo_kwargs": {"n_epochs": 0}}, "algo_kwargs.n_epochs: expected a whole number in [1, 1e9], got 0"),
        ({"algo_kwargs": {"n_steps": 1.5}}, "algo_kwargs.n_steps: expected a whole number in [1, 1e9], got 1.5"),
        ({"algo_kwargs": {"gamma": True}}, "algo_kwargs.gamma: expected a number in (0, 1], got True"),
        ({"algo_kwargs": {"clip_range": 0}}, "algo_kwargs.clip_range: expected a number in (0, 10] or lin_NUMBER,"),
    ],
)
def test_what_cannot_be(values, message):
    with pytest.raises(RecipeError) as caught:
        validate(values, "recipe.yaml")
    assert str(caught.value).startswith(f"recipe.yaml: {message}")
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    "kwargs",
    [
        {"learning_rate": "lin_3e-4"},
        {"ent_coef": "auto_0.1"},
        {"n_steps": 1e3},
        {"train_freq": 8},
        {"gradient_steps": -1},
        {"n_steps": np.int64(64)},
    ],
)
def test_what_can_be(kwargs):
    algo = "sac" if {"ent_coef", "train_freq", "gradient_steps"} & kwargs.keys() else "ppo"
    assert validate({"algo": algo, "algo_kwargs": kwargs, "n_envs": 1}, "recipe").algo_kwargs == kwargs


def test_numbers_of_the_command_line():
    values = sources.merge_flags(["n_envs=4", "seed=1"], seed=7, total_timesteps="1e6", algo=None)
    assert values == {"n_envs": 4, "seed": 7, "total_timesteps": 1e6}
    assert validate(values, "recipe").total_timesteps == 1_000_000


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["task.size"], "--set 'task.size': write key=value, for example --set task.tolerance=0.02"),
        (["=3"], "--set '=3': write key=value, for example --set task.tolerance=0.02"),
        (["task.a=1", "task.a.b=2"], "--set 'task.a.b=2': an earlier --set gives 'a' a value, so it cannot have keys"),
        (["task.a=[1"], "--set task.a:1: expected ',' or ']', but got '<stream end>'"),
    ],
)
def test_settings_that_cannot_be_read(settings, message):
    with pytest.raises(RecipeError) as caught:
        parse_settings(settings)
    assert str(caught.value) == message


def test_settings_of_verbs_that_take_an_environment():
    assert parse_changes([]) == UNCHANGED
    assert not parse_changes([])
    assert parse_changes(["task.tolerance=0.02", "task.name=[a, b]"]).parameters == {
        "tolerance": 0.02,
        "name": ["a", "b"],
    }
    assert parse_changes(["randomize=false", "events.mass.factor=[0.9, 1.1]"]) == EnvChanges(
        randomize=False, events={"mass": {"factor": [0.9, 1.1]}}
    )
    for setting, message in {
        "taks.tolerance=1": "--set taks: only task.NAME, reward_weights.NAME, randomize, events.NAME and sim can be "
        "set here. Did you mean 'task'?",
        "n_envs=3": "--set n_envs: only task.NAME, ",
        "task=1": "--set: task: expected a mapping, got 1",
        "randomize=maybe": "--set: randomize: expected true or false, got 'maybe'",
        "events.mass=3": "--set: events.mass: expected a mapping, got 3",
    }.items():
        with pytest.raises(RecipeError) as caught:
            parse_changes([setting])
        assert str(caught.value).startswith(message)


def test_what_is_changed_goes_over_what_was_trained_with():
    trained = EnvSpec("reach", {"a": 1}, {"x": 1.0}, True, {"mass": {"factor": [0.5, 2.0], "body": "arm"}})
    assert UNCHANGED.apply(trained) == trained
    changed = EnvChanges({"b": 2}, {"y": 3.0}, None, {"mass": {"factor": [1, 1]}}).apply(trained)
    assert changed == EnvSpec(
        "reach", {"a": 1, "b": 2}, {"x": 1.0, "y": 3.0}, True, {"mass": {"factor": [1, 1], "body": "arm"}}
    )
    # Mapping by mapping, as a recipe is put together.
    trained = EnvSpec("reach", {"arm": {"length": 1, "mass": 2}}, events={"mass": {"factor": {"from": 1, "to": 2}}})
    changed = EnvChanges({"arm": {"mass": 3}}, events={"mass": {"factor": {"to": 3}}}).apply(trained)
    assert changed.parameters == {"arm": {"length": 1, "mass": 3}}
    assert changed.events == {"mass": {"factor": {"from": 1, "to": 3}}}
    # Not randomised: also the events go that it was trained with, but for those that are asked for.
    calm = EnvChanges(randomize=False, events={"push": {}}).apply(trained)
    assert (calm.randomize, calm.events) == (False, {"push": {}})


def test_a_file_that_is_none(tmp_path, config):
    with pytest.raises(ArtifactError, match=r"^no recipe file .*/missing.yaml. Presets: presets/ant-v5, "):
        resolve("a.py:A", tmp_path / "missing.yaml", {})
    with pytest.raises(ArtifactError, match=r"^no recipe file .*/PPO.yaml. Did you mean 'presets/ppo'\? Presets: "):
        resolve("a.py:A", tmp_path / "PPO.yaml", {})
    (tmp_path / "run").mkdir()
    with pytest.raises(ArtifactError, match=r"/run: a folder, not a recipe; there is no \.yaml file in it$"):
        resolve("a.py:A", tmp_path / "run", {})
    (tmp_path / "run" / "recipe.yaml").touch()
    with pytest.raises(ArtifactError, match=r"/run: a folder, not a recipe; in it is .*/run/recipe\.yaml$"):
        resolve("a.py:A", tmp_path / "run", {})
    with pytest.raises(RecipeError, match=r"config.yaml: expected a mapping of keys to values, got a list$"):
        resolve("a.py:A", config("- algo"), {})
    assert resolve("a.py:A", config("# nothing\n"), {}).algo == "ppo"
    (tmp_path / "config.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecipeError, match=r"config.yaml: not UTF-8 text: .* at byte 0; save it as UTF-8$"):
        resolve("a.py:A", tmp_path / "config.yaml", {})


def test_the_error_names_where_the_value_is_from(packaged, tmp_path, config):
    (tmp_path / "my_env.yaml").write_text("algo: ppo\nalgo_kwargs:\n  gamma: 7\n")
    file = config("n_envs: 2\neval:\n  episodes: 0\n")

    def message(config, settings):
        with pytest.raises(RecipeError) as caught:
            resolve(packaged, config, parse_settings(settings))
        return str(caught.value)

    assert message(None, []).startswith(f"{tmp_path / 'my_env.yaml'}:3: algo_kwargs.gamma: expected a number in (0, 1]")
    assert message(file, ["algo_kwargs.gamma=1"]).startswith(f"{file}:3: eval.episodes: expected a whole number ")
    assert message(file, ["algo_kwargs.gamma=8"]).startswith("algo_kwargs.gamma: expected a number in ")
    assert message(file, ["eval.episodes=1", "algo_kwargs.gama=1"]).startswith(f"{tmp_path / 'my_env.yaml'}:3: ")
    (tmp_path / "my_env.yaml").write_text("algo: ppo\n")
    assert message(file, ["eval.episodes=1", "algo_kwargs.gama=1"]).startswith(
        "no key 'algo_kwargs.gama' for ppo. Did you mean 'gamma'?"
    )
    stages = config("stages:\n  - {level: 0.5}\n  - {levle: 1}\n")
    assert message(stages, []).startswith(f"{stages}:3: stage 2: no key 'levle'. Did you mean 'level'? Keys here: task")


def test_every_mistake_is_named_up_to_three(packaged, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("n_envs: 0\npolicy_kwargs:\n  net_arch: [a, 2.5]\nalgo_kwargs:\n  gamma: 99\n")
    with pytest.raises(RecipeError) as caught:
        resolve(packaged, file, {"seed": -1})
    assert [line.split(" expected")[0] for line in str(caught.value).splitlines()] == [
        f"{file}:5: algo_kwargs.gamma:",
        f"{file}:3: policy_kwargs.net_arch:",
        "and 2 more mistakes",
    ]
    with pytest.raises(RecipeError) as caught:
        resolve(packaged, file, {"seed": -1, "policy_kwargs": {"net_arch": [8]}})
    assert [line.split(" expected")[0] for line in str(caught.value).splitlines()] == [
        f"{file}:5: algo_kwargs.gamma:",
        f"{file}:1: n_envs:",
        "seed:",
    ]


def test_units_of_the_number_of_steps():
    for text, steps in (("20k", 20_000), ("1.5M", 1_500_000), ("1e4", 10_000)):
        assert resolve("reach", None, sources.merge_flags([], total_timesteps=text)).total_timesteps == steps


def test_a_shorter_training_is_evaluated_as_often():
    assert resolve("reach", None, {}).eval.every_steps == 40_000
    assert resolve("reach", None, {"total_timesteps": 120_000}).eval.every_steps == 40_000
    assert resolve("reach", None, {"total_timesteps": 20_000}).eval.every_steps == 4_000
    chosen = {"total_timesteps": 20_000, "eval": {"every_steps": 10_000}}
    assert resolve("reach", None, chosen).eval.every_steps == 10_000


def test_command_shows_the_merged_recipe(rlctl, config):
    file = config("n_envs: 4\n")
    done = rlctl("recipe", "reach", "--config", file, "--algo", "sac", "--set", "algo_kwargs.gamma=0.9")
    assert done.returncode == 0, done.stderr
    expected = resolve("reach", file, {"algo": "sac", "algo_kwargs": {"gamma": 0.9}})
    assert done.stdout == expected.to_yaml()
    assert "is for ppo; not used for sac: algo_kwargs, policy_kwargs; used: total_timesteps 120000" in done.stderr
    assert rlctl("recipe", "reach", "--algo", "sacc").returncode == 2


@pytest.mark.parametrize(
    ("task", "parameters", "message"),
    [
        ("Pendlum-v1", {}, "Gymnasium has no environment 'Pendlum-v1'. Did you mean 'Pendulum-v1'?"),
        ("reach", {"tolerence": 0.1}, "task.tolerence: Reach has no parameter 'tolerence'. Did you mean 'tolerance'?"),
        ("CartPole-v1", {"suton": 1}, "task.suton: CartPole-v1 has no parameter 'suton'."),
    ],
)
def test_names_are_checked_before_anything_is_built(task, parameters, message):
    with pytest.raises(RlctlError) as caught:
        sources.resolve_with_stages(task, None, {"task": parameters})
    assert str(caught.value).startswith(message)
