"""Requests refused or warned of before anything is trained: recipes, arguments that exclude each other, devices."""

import pytest

from rlctl.errors import RecipeError, UsageError
from rlctl.launching.train import run_training
from rlctl.recipe import recipe as recipes
from rlctl.runs.train_request import TrainRequest


@pytest.mark.slow_except(first=3)
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"algo_kwargs": {"n_step": 16}}, "no key 'algo_kwargs.n_step' for ppo. Did you mean 'n_steps'?"),
        ({"algo": "sac", "algo_kwargs": {"n_epochs": 3}}, "no key 'algo_kwargs.n_epochs' for sac."),
        ({"policy_kwargs": {"net_arc": [8]}}, "no key 'policy_kwargs.net_arc' for ppo. Did you mean 'net_arch'?"),
        (
            {"policy_kwargs": {"activation_fn": "rellu"}},
            "or FILE.py:CLASS or MODULE:CLASS, got 'rellu'. Did you mean 'relu'?",
        ),
        ({"algo_kwargs": {"learning_rate": "lin_fast"}}, "a number in (0, 1] or lin_NUMBER, got 'lin_fast'"),
        ({"algo": "dqn"}, "dqn cannot be used here: "),
        ({"task": {"colour": 1}}, "task.colour: "),
        ({"reward_weights": {"speed": 1.0}}, "is a plain Gymnasium environment; only tasks have them"),
    ],
)
def test_recipe_errors_name_the_key(train, small_ppo, settings, message):
    if settings.get("algo", "ppo") != "ppo":
        small_ppo.pop("algo_kwargs")
    with pytest.raises(RecipeError) as caught:
        train("Line", recipes.merge(small_ppo, settings))
    assert message in str(caught.value)


@pytest.mark.slow
def test_a_reward_weight_of_the_other_sign_is_warned_of(train, small_ppo, capsys):
    stages = [{"reward_weights": {"distance": 2.0}, "promote": {"return": 0.0}}, {"reward_weights": {"distance": -0.5}}]
    train("reach", recipes.merge(small_ppo, {"stages": stages}))
    warnings = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: reward_weights")]
    assert warnings == ["warning: reward_weights.distance: 2 has the opposite sign of the task's own, -1"]


def test_task_and_resume_exclude_each_other():
    with pytest.raises(UsageError, match="TASK and --resume exclude each other"):
        run_training(TrainRequest("reach", resume="latest", check=False))
    with pytest.raises(UsageError, match="neither TASK nor --resume is given"):
        run_training(TrainRequest(check=False))


@pytest.mark.parametrize(
    ("device", "message"), [("gpu", "--device 'gpu': no such device"), ("cuda:99", "--device cuda:99: ")]
)
def test_a_device_that_is_not_there(train, small_ppo, device, message):
    with pytest.raises(UsageError, match=message):
        train("Line", small_ppo, device=device)
