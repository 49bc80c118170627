"""When a stage of a curriculum is left: by the episodes that ended in it, and its steps."""

from rlctl.play.messages import EpisodeResult
from rlctl.recipe.recipe import validate
from rlctl.training.learner import Curriculum
from rlctl.training.progress import Progress


def curriculum(*stages):
    recipe = validate({"stages": [*stages, {}]}, "recipe")
    return Curriculum(recipe.stages, recipe.env_specs("any"), None, Progress(next_eval=1))


def ended(*successes, total=0.0):
    return [EpisodeResult(0, 0, total, 10, success, {}, None) for success in successes]


def test_a_window_must_be_full_and_only_its_episodes_count():
    stages = curriculum({"promote": {"success": 0.75, "window": 4}})
    stages.count(ended(True, True, True))
    assert not stages.is_due(1000)
    stages.count(ended(False, False))  # the last four: 2 of 4
    assert not stages.is_due(1000)
    stages.count(ended(True, True, True))  # 3 of 4
    assert stages.is_due(1000)
    assert stages.enter_next_stage(1000) == (
        "stage 2 of 2: the recipe's own task",
        "after 1,000 steps: success 75.0% over 4 episodes",
    )
    stages.count(ended(*[True] * 9))
    assert not stages.is_due(2000)


def test_min_steps_are_steps_of_the_stage():
    stages = curriculum(*[{"promote": {"return": 5.0, "window": 1, "min_steps": 100}}] * 2)
    stages.count(ended(None, total=5.0))
    assert not stages.is_due(99)
    assert stages.is_due(100)
    stages.enter_next_stage(120)
    stages.count(ended(None, total=5.0))
    assert not stages.is_due(219)
    assert stages.is_due(220)


def test_missing_success_counts_as_none():
    stages = curriculum({"promote": {"success": 0.5, "window": 2}})
    stages.count(ended(None, None))
    assert not stages.is_due(1000)
    stages.count(ended(True))  # of an environment that speaks of success only when there is one: 1 of 2
    assert stages.is_due(1000)
