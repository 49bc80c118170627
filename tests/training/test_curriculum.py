"""Stages: promotion at the boundaries between updates, by episodes alone; evaluation in the last stage."""

import csv
import io

import pytest
from rich.console import Console

from rlctl import load_policy
from rlctl.errors import RecipeError, UsageError
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.evaluate import run_evaluation
from rlctl.launching.train import run_training
from rlctl.play.episode import load_episode
from rlctl.play.workers import available_cores
from rlctl.policy.file import PolicyFile
from rlctl.replaying.reproduce import verify_episode
from rlctl.runs.train_request import TrainRequest
from rlctl.training import checkpoint_file
from rlctl.training.display import LiveDisplay
from tests.training.comparing import replay_buffer
from tests.training.conftest import ENVS, SMALL, SMALL_PPO

# Four environments, episodes of 10 steps, updates every 16: by step 64, 128, 192, 256 of the training
# 4, 12, 16, 24 episodes have ended.
EASY, HARD = {"tolerance": 0.5}, {"tolerance": 0.0}  # |x| stays below 0.5 and above 0: all succeed, none does
BY_SUCCESS = [{"task": EASY, "promote": {"success": 0.8, "window": 5}}, {"task": HARD}]


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def column(path, name, kind=int):
    return [kind(row[name]) for row in rows(path)]


def saved(run):
    return checkpoint_file.read_newest(run)[0]


@pytest.fixture(scope="module")
def staged(tmp_path_factory):
    """A run that goes from EASY to HARD at step 128, the second boundary."""
    root = tmp_path_factory.mktemp("runs")
    return run_training(
        TrainRequest(f"{ENVS}:Staged", settings={**SMALL_PPO, "stages": BY_SUCCESS}, root=root, check=False)
    )


@pytest.mark.slow
def test_promotion_by_success(staged):
    run = staged.run
    assert column(run.metrics_file, "steps") == [64, 128, 192, 256]
    assert column(run.metrics_file, "stage") == [1, 1, 2, 2]
    assert column(run.metrics_file, "success", float) == [1.0, 1.0, 0.0, 0.0]
    assert (staged.progress.stage, len(staged.recipe.stages), run.status()["stage"]) == (2, 2, 2)


@pytest.mark.slow
def test_evaluation_is_always_in_the_last_stage(staged):
    assert column(staged.run.evals_file, "success", float) == [0.0, 0.0]
    assert column(staged.run.evals_file, "stage") == [2, 2]  # what the policy is trained in from this step on
    for file in staged.run.episodes.glob("*.npz"):
        info = load_episode(file).info
        assert (info.spec.stage, info.spec.parameters) == (2, HARD)


@pytest.mark.slow
def test_checkpoints_know_the_stage_and_addresses_go_on(staged):
    found = saved(staged.run)
    assert (found.state.progress.stage, found.state.progress.stage_began, found.state.progress.stage_episodes) == (
        2,
        128,
        [],
    )
    # 32 steps: three episodes ended, the fourth was left; the fifth begins the stage. Then three ended again.
    assert found.tensors["environments/episodes_started"].tolist() == [8] * 4
    assert found.tensors["environments/steps"].tolist() == [2] * 4


def test_tensorboard_has_the_stage(staged):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(staged.run.tensorboard))
    events.Reload()
    # SB3 writes after a rollout what was logged at the boundary before it.
    assert [(each.step, each.value) for each in events.Scalars("curriculum/stage")][-1] == (256, 2.0)


def test_policy_file_has_all_stages(staged):
    info = load_policy(staged.run.best_policy).info
    assert info.derive_spec().parameters == HARD
    assert [info.stages[number - 1].parameters for number in (1, 2)] == [EASY, HARD]


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(("stage", "rate"), [(None, 0.0), (1, 1.0), (2, 0.0)])
def test_eval_of_a_stage(staged, stage, rate):
    result = run_evaluation(EvalRequest(str(staged.run.path), episodes=3, stage=stage))
    assert (result.success_rate, result.spec.stage) == (rate, stage or 2)


@pytest.mark.parametrize("stage", [0, 3])
def test_eval_of_a_stage_that_is_not_there(staged, stage):
    message = f"--stage {stage}: this policy has 2 stages"
    with pytest.raises(UsageError, match=message):
        run_evaluation(EvalRequest(str(staged.run.path), stage=stage))


@pytest.mark.slow
def test_without_stages_there_is_no_stage_anywhere(train, small_ppo):
    result = train("Line", small_ppo)
    assert "stage" not in rows(result.run.metrics_file)[0]
    assert "stage" not in rows(result.run.evals_file)[0]
    with pytest.raises(UsageError, match="--stage 1: this policy has 0 stages"):
        run_evaluation(EvalRequest(str(result.run.path), stage=1))


@pytest.mark.slow
def test_promotion_by_return_in_plain_lines(train, small_ppo, capsys):
    # An episode returns -10 * cost: -10 reaches -10, and -20 does not reach -15.
    stages = [
        {"task": {"cost": 1.0}, "promote": {"return": -10.0, "window": 4}},
        {"task": {"cost": 2.0}, "promote": {"return": -15.0, "window": 4}},
        {},
    ]
    result = train("Staged", {**small_ppo, "stages": stages})
    assert column(result.run.metrics_file, "stage") == [1, 2, 2, 2]
    assert column(result.run.metrics_file, "return", float) == [-10.0, -20.0, -20.0, -20.0]
    lines = capsys.readouterr().err.splitlines()
    assert "stage 1 of 3: cost 1.0" in lines
    assert "stage 2 of 3: cost 2.0  (after 64 steps: return -10.00 over 4 episodes)" in lines
    assert not any(line.startswith("stage 3") for line in lines)


def test_live_display_shows_the_stage():
    display = LiveDisplay("train any (ppo)", 100)
    display.stage("stage 2 of 3: cost 2.0", "after 64 steps: return -10.00 over 4 episodes")
    console = Console(file=io.StringIO(), width=100)
    console.print(display)
    assert "  stage 2 of 3: cost 2.0  (after 64 steps: return" in console.file.getvalue()


@pytest.mark.slow
def test_promotion_does_not_depend_on_time_or_on_the_number_of_workers(staged, train, small_ppo, use_cores):
    with use_cores(1 if available_cores() > 1 else None):
        again = train("Staged", {**small_ppo, "stages": BY_SUCCESS})
    one, two = (PolicyFile.read(result.run.last_policy).tensors for result in (staged, again))
    assert all((one[key] == two[key]).all() for key in one)
    kept = ("steps", "stage", "return", "success", "loss")
    assert [[row[key] for key in kept] for row in rows(staged.run.metrics_file)] == [
        [row[key] for key in kept] for row in rows(again.run.metrics_file)
    ]


@pytest.mark.slow
def test_resume_goes_on_in_the_middle_of_a_stage(train, resume, small_ppo):
    stages = [
        {"task": EASY, "promote": {"success": 1.0, "window": 4}},
        {"task": {"tolerance": 0.51}, "promote": {"success": 1.0, "window": 14}},
        {"task": HARD},
    ]
    result = train("Staged", {**small_ppo, "total_timesteps": 192, "stages": stages})
    progress = saved(result.run).state.progress
    # Stage 2 began at 64; 32 steps later three episodes of each environment are over.
    assert (progress.stage, progress.stage_began, progress.stage_episodes) == (2, 64, [1.0] * 12)
    resume(result, total_timesteps=384)
    # 16 steps later the fourth is over too, and 16 fill the window of 14.
    assert column(result.run.metrics_file, "steps") == [64, 128, 192, 256, 320, 384]
    assert column(result.run.metrics_file, "stage") == [1, 2, 2, 2, 3, 3]
    assert column(result.run.metrics_file, "success", float) == [1.0, 1.0, 1.0, 1.0, 0.0, 0.0]


@pytest.mark.slow
def test_a_stage_that_is_done_with_the_training_is_left_by_its_resume(train, resume, small_ppo):
    stages = [{"task": EASY, "promote": {"success": 1.0, "window": 4}}, {"task": HARD}]
    result = train("Staged", {**small_ppo, "total_timesteps": 64, "stages": stages})
    assert (result.progress.stage, saved(result.run).state.progress.stage_began) == (2, 64)
    resume(result, total_timesteps=128)
    assert column(result.run.metrics_file, "stage") == [1, 2]
    assert column(result.run.metrics_file, "success", float) == [1.0, 0.0]


@pytest.mark.slow
def test_an_off_policy_algorithm_keeps_its_replay_buffer(train):
    stages = [
        {"task": {"cost": 1.0}, "promote": {"return": -10.0, "window": 4, "min_steps": 48}},
        {"task": {"cost": 2.0}},
    ]
    settings = {**SMALL, "algo": "sac", "algo_kwargs": {"learning_starts": 32, "batch_size": 16}, "stages": stages}
    result = train("Staged", {**settings, "total_timesteps": 128})
    buffer = replay_buffer(result.run, saved(result.run).state.segments)
    # Updates come after each step of the four: 48 steps are transitions 0 to 11, 128 are 32.
    assert [buffer[number]["rewards/"][0] for number in range(32)] == [-1.0] * 12 + [-2.0] * 20
    # Time limits at the tenth step; the episode left at transition 11 is cut there as well.
    assert [number for number in range(32) if buffer[number]["timeouts/"][0]] == [9, 11, 21, 31]
    steps, stage = (column(result.run.metrics_file, name) for name in ("steps", "stage"))
    assert dict(zip(steps, stage, strict=True))[48] == 1
    assert {stage for step, stage in zip(steps, stage, strict=True) if step > 48} == {2}


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize(
    ("second", "message"),
    [
        (
            {"task": {"size": 2}},
            r"^stage 2 of 2: its observation space is Box\(-10.0, 10.0, \(2,\), float32\), stage 1's is "
            r"Box\(-10.0, 10.0, \(1,\), float32\). One policy learns in all stages",
        ),
        ({"task": {"tolerence": 0.1}}, r"^stage 2 of 2: task.tolerence: .*Did you mean 'tolerance'\?"),
        ({"reward_weights": {"x": 1.0}}, r"^stage 2 of 2: reward_weights: .* is a plain Gymnasium environment"),
    ],
)
def test_a_stage_that_cannot_be_is_refused_before_training(train, small_ppo, tmp_path, second, message):
    with pytest.raises(RecipeError, match=message):
        train("Staged", {**small_ppo, "stages": [{"promote": {"return": 0.0}}, second]})
    assert not list(tmp_path.glob("runs/*/*/run.json"))


REACH = """
from rlctl_manipulation.reach import Reach
class NearThenExact(Reach):
    stages = [
        {"task": {"tolerance": 0.2}, "level": 0.1, "promote": {"return": -1000.0, "window": 4}},
        {"task": {"tolerance": 0.05}},
    ]
class NoSuccess(NearThenExact):
    from rlctl.task import Task
    is_success = Task.is_success
    stages = [{"promote": {"success": 0.5}}, {}]
"""


@pytest.mark.slow
def test_reach_in_stages_of_its_class(write_module, tmp_path):
    task = f"{write_module('my_reach.py', REACH)}:NearThenExact"
    settings = {
        "n_envs": 4,
        "total_timesteps": 1536,
        "frame_stack": 2,
        "eval": {"episodes": 2, "every_steps": 1024},
        "algo_kwargs": {"n_steps": 128, "batch_size": 128, "n_epochs": 1},
        "events": {"mass": {"factor": {"from": [1.0, 1.0], "to": [0.9, 1.1]}}},
    }
    result = run_training(TrainRequest(task, settings=settings, root=tmp_path, check=False))
    # 128 steps hold an episode of 120.
    assert column(result.run.metrics_file, "stage") == [1, 2, 2]
    assert result.run.recipe().stages[0].task == {"tolerance": 0.2}
    for file in result.run.episodes.glob("*.npz"):
        episode = load_episode(file)
        assert (episode.info.spec.stage, episode.info.spec.parameters) == (2, {"tolerance": 0.05})
        assert verify_episode(episode, file)[1].difference is None
    info = load_policy(result.run.last_policy).info
    assert [info.stages[number - 1].level for number in (1, 2)] == [0.1, info.spec.level] == [0.1, 1.0]
    near, exact = (run_evaluation(EvalRequest(str(result.run.path), episodes=2, stage=stage)) for stage in (1, 2))
    # The same policy and goals, and the mass makes no great difference; `reached` is measured by the tolerance.
    assert near.terms["reached"] > exact.terms["reached"]


@pytest.mark.slow
def test_success_of_a_task_that_has_none_is_refused(write_module, tmp_path, small_ppo):
    task = f"{write_module('my_reach.py', REACH)}:NoSuccess"
    with pytest.raises(RecipeError, match=r"^stage 1 of 2: promote.success: .*NoSuccess does not report success"):
        run_training(TrainRequest(task, settings=small_ppo, root=tmp_path, check=False))
