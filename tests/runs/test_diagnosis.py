"""Each finding in a training made sick for it, as tables and episodes of a run folder; and none in healthy ones."""

import csv
import json

import numpy as np
import pytest
import yaml
from gymnasium import spaces

from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.environments.spec import EnvSpec
from rlctl.play.episode import EpisodeInfo, RecordedEpisode, save_episode
from rlctl.policy.file import PolicyFile, PolicyInfo
from rlctl.runs.diagnosis.findings import Grade, diagnose, format_end, format_finding, list_signs
from rlctl.runs.directory import RunDirectory

UPDATES = 30
STEPS = 1000 * np.arange(1, UPDATES + 1)
RISING = np.linspace(-50, 50, UPDATES)
ENV = EnvInfo(
    observation_space=space_to_json(spaces.Box(-np.inf, np.inf, (3,), np.float32)),
    action_space=space_to_json(spaces.Box(-1.0, 1.0, (2,), np.float32)),
    observation_sizes={"position": 2, "turning": 1},
    observation_units={"position": "m", "turning": "rad/s"},
    control_dt=0.05,
    reward_weights={"alive": 1.0, "progress": 1.0},
    max_steps=200,
)
# Of a perfect run of reach, a little simplified: large steps of the policy alone mean nothing.
HEALTHY = {
    "return": RISING,
    "length": 200,
    "success": np.linspace(0, 1, UPDATES),
    "approx_kl": 0.05,
    "clip_fraction": 0.35,
    "explained_variance": 0.4,
    "exploration": np.linspace(0.6, 0.4, UPDATES),
    "action_saturation": 0.13,
    "terminated": 0.0,
    "value": RISING / 2,
    "gradient_norm": 0.5,
    "playing": 0.75,
    "acting": 0.2,
    "fps": 3000,
}
FLAT = {"return": -50 + np.tile([0.5, -0.5, 1.0], 10), "success": 0.0}


@pytest.fixture
def write_training(tmp_path):
    """Write a run folder with the given columns of metrics and evaluations, of a healthy run where not given."""

    def write(metrics=(), evaluations=(), recipe=(), episodes=(), env=ENV, **status):
        columns = {"steps": STEPS, **HEALTHY, **dict(metrics)}
        every = slice(5, None, 6)
        evaluated = {name: columns[name] for name in ("return", "length", "success") if columns[name] is not None}
        evaluated = {name: np.broadcast_to(values, UPDATES)[every] for name, values in evaluated.items()}
        run = RunDirectory(tmp_path / "run")
        run.path.mkdir()
        _write_table(run.metrics_file, columns)
        _write_table(run.evals_file, {"steps": STEPS[every], **evaluated, **dict(evaluations)})
        run.recipe_file.write_text(
            yaml.safe_dump(
                {"algo": "ppo", "algo_kwargs": {"learning_rate": 0.0009}, "total_timesteps": 30_000, **dict(recipe)}
            )
        )
        run.status_file.write_text(json.dumps({"status": "finished", "task": "reach", **status}))
        PolicyFile(PolicyInfo(algo="ppo", policy="MlpPolicy", env=env, spec=EnvSpec("reach")), {}).write(
            run.last_policy
        )
        for number, episode in enumerate(episodes):
            save_episode(run.episode_file(number), episode)
        return run

    return write


def _write_table(path, columns):
    columns = {name: values for name, values in columns.items() if values is not None}
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*np.broadcast_arrays(*columns.values()), strict=True))


def make_episode(actions, observations=None, terms=None):
    steps = len(actions)
    terms = np.column_stack([np.ones(steps), np.sin(np.arange(steps))]) if terms is None else terms
    observations = np.zeros((steps + 1, 3), np.float32) if observations is None else observations
    names = ["alive", "progress"]
    info = EpisodeInfo(
        spec=EnvSpec("reach"), seed=1, policy="training step 1", total_reward=float(terms.sum()), term_names=names
    )
    return RecordedEpisode(actions.astype(np.float32), observations, terms.sum(axis=1), terms, info)


SMOOTH = np.column_stack([np.sin(np.arange(100) / 20), np.cos(np.arange(100) / 20)])
SHAKING = np.tile([[0.8, -0.8], [-0.8, 0.8]], (50, 1))


STANDING = {"return": np.minimum(20.0 * np.arange(UPDATES), 200.0), "success": None}


def survive(speed):
    """Return an episode in which progress pays `speed` on average, and being alive 1."""
    return make_episode(SMOOTH, terms=np.column_stack([np.ones(100), speed * (1 + SMOOTH[:, 0])]))


def ids(run, grade=None):
    return [each.id for each in diagnose(run) if grade in (None, each.grade)]


def test_healthy_training_has_no_finding(write_training):
    assert diagnose(write_training(episodes=[make_episode(SMOOTH)])) == []


def test_a_reward_that_is_hardly_ever_paid_is_not_constant(write_training):
    # As of a kernel that is far too narrow: only costs are there.
    costly = make_episode(SMOOTH, terms=np.column_stack([np.full(100, 1e-9), -1.0 + 0.1 * SMOOTH[:, 0]]))
    assert "Q1" not in ids(write_training(STANDING, episodes=[costly]))


def test_training_that_is_still_flat_at_a_third_has_no_finding(write_training):
    run = write_training({**FLAT, "explained_variance": 0.0}, recipe={"total_timesteps": 90_000}, status="running")
    assert diagnose(run) == []


def test_noisy_return_with_rising_evaluations_has_no_finding(write_training):
    # As of the quadruped: exploration makes it fall, the policy itself walks ever farther.
    noisy = np.tile([30.0, -60.0, 0.0], 10)
    assert diagnose(write_training({"return": noisy}, {"return": [130, 132, 140, 150, 176]})) == []


def test_rare_success_at_the_beginning_has_no_finding(write_training):
    # As of reach-sparse: -1 in every step until the goal is reached, by chance at first.
    lucky = np.full(UPDATES, -120.0)
    lucky[2:6] = [-119, -115, -118, -119]
    assert diagnose(write_training({"return": lucky, "success": None, "explained_variance": None})) == []


def test_saturated_actions_of_a_policy_that_still_learns_are_no_finding(write_training):
    # As of the biped: torques at their limits push it forward long before it walks the whole way.
    assert diagnose(write_training({"success": 0.0, "action_saturation": 0.9})) == []


def test_constant_return_of_a_robot_that_walks_is_no_finding(write_training):
    assert diagnose(write_training(STANDING, episodes=[survive(1.0)])) == []


def test_standing_that_still_gets_longer_is_no_finding(write_training):
    longer = {**STANDING, "length": np.linspace(20, 120, UPDATES)}
    assert diagnose(write_training(longer, episodes=[survive(0.02)])) == []


@pytest.mark.parametrize(
    ("id", "metrics", "more"),
    [
        ("Q1", {**FLAT, "length": np.tile([12, 11, 13], 10), "terminated": 1.0}, {}),
        ("Q1", FLAT, {"episodes": [make_episode(0.001 * SMOOTH)]}),
        ("Q1", {**FLAT, "approx_kl": 1e-6, "clip_fraction": 0.0}, {}),
        ("Q1", STANDING, {"episodes": [survive(0.02)]}),
        ("Q1", {"return": np.minimum(RISING, -25), "success": 0.0}, {}),
        ("Q2", {"success": 0.0, "distance": np.linspace(0.2, 0.9, UPDATES)}, {}),
        ("Q2", {"success": 0.0}, {"episodes": [make_episode(SHAKING, terms=np.eye(100, 2))]}),
        ("Q3", {"return": np.tile([0.0, 90.0, 10.0], 10), "approx_kl": 0.6, "clip_fraction": 0.7}, {}),
        ("Q3", {"approx_kl": 3.0, "clip_fraction": 0.85, "success": 0.1}, {}),
        ("Q3", {"success": 0.0, "value": np.geomspace(1, 1e6, UPDATES)}, {"episodes": [make_episode(SMOOTH)]}),
        ("Q3", {**FLAT, "gradient_norm": np.geomspace(0.1, 1e9, UPDATES)}, {"episodes": [make_episode(SMOOTH)]}),
        ("Q3", {}, {"status": "diverged", "error": "training diverged: loss is not finite at step 900."}),
        ("Q5", {}, {"status": "failed", "error": "task 'arm': Cannot load URDF file arm.urdf"}),
        ("Q7", {"success": None}, {"episodes": [make_episode(SHAKING, terms=np.tile([1.0, 0.0], (100, 1)))]}),
        ("Q9", {**FLAT, "explained_variance": 0.01}, {}),
        ("Q9", {"terminated": 1.0, "explained_variance": 0.01}, {}),
        (
            "Q10",
            {
                "success": 0.0,
                "terminated": 1.0,
                "length": np.linspace(150, 30, UPDATES),
                "term/alive": 5.0,
                "term/energy": RISING - 90,
            },
            {},
        ),
        ("Q11", {"return": np.concatenate([RISING[:15], np.full(15, -45.0)]), "success": None}, {}),
        ("Q12", {**FLAT, "exploration": np.geomspace(0.6, 1e-4, UPDATES)}, {}),
        ("Q12", {**FLAT, "action_saturation": np.linspace(0.3, 0.97, UPDATES)}, {}),
        ("Q12", {**FLAT, "exploration": np.linspace(0.6, 30.0, UPDATES)}, {}),
    ],
)
def test_sick_training_is_found(write_training, id, metrics, more):
    run = write_training(metrics, **more)
    assert ids(run, Grade.WARNING) == [id]
    (finding,) = (each for each in diagnose(run) if each.id == id)
    assert finding.evidence
    assert finding.advice


def test_an_averaged_actor_that_is_young_explains_low_evaluations(write_training):
    """The average is over 1 / (1 - 0.9997) = 3,333 updates."""
    metrics = {"return": np.linspace(20, 1000, UPDATES), "n_updates": STEPS, "success": None}
    evaluations = {"return": np.full(len(STEPS[5::6]), 85.0)}
    recipe = {"algo": "xqc"}  # which has an average by default
    (finding,) = (each for each in diagnose(write_training(metrics, evaluations, recipe)) if each.id == "Q16")
    # The last evaluation is at the last row; the median of the returns of the last three rows is that of the 29th.
    assert (
        f"is {np.linspace(20, 1000, UPDATES)[-2]:.4g}, the evaluation's 85, after 30,000 updates" in finding.evidence[0]
    )
    assert "the average is over 3,333" in finding.evidence[0]


@pytest.mark.parametrize(
    ("algo", "updates", "evaluated"),
    [("crossq", STEPS, 85.0), ("xqc", 10 * STEPS, 85.0), ("xqc", STEPS, 800.0)],
    ids=["no average", "an old average", "it follows"],
)
def test_other_low_evaluations_are_not_explained_by_an_average(write_training, algo, updates, evaluated):
    metrics = {"return": np.linspace(20, 1000, UPDATES), "n_updates": updates, "success": None}
    evaluations = {"return": np.full(len(STEPS[5::6]), evaluated)}
    assert "Q16" not in ids(write_training(metrics, evaluations, {"algo": algo}))


def test_advice_on_slow_updates_is_for_the_algorithm(write_training):
    recipe = {"algo": "xqc", "algo_kwargs": {"train_freq": 4, "gradient_steps": -1, "batch_size": 256}}
    (finding,) = diagnose(write_training({"playing": 0.1}, recipe=recipe))
    assert (finding.id, finding.evidence[-1]) == ("Q13", "train_freq 4, gradient_steps -1")
    text = "\n".join(format_finding(finding))
    assert "`algo_kwargs.train_freq` 4 is one per 4 steps" in text
    assert "epochs" not in text
    assert "batch_size is 256: usually 32 to 1024, often 256; raise: less noise, slower updates" in text


@pytest.mark.parametrize(
    ("id", "metrics", "more"),
    [
        ("Q4", {"playing": 0.97, "fps": 40}, {}),
        ("Q6", {}, {"observations_outside": 7}),
        ("Q13", {"playing": 0.1}, {}),
        ("Q13", {"playing": 0.9, "acting": 0.6}, {}),
        ("Q11", {}, {"evaluations": {"return": [0, 90, 50, 40, 55]}}),
    ],
)
def test_what_is_worth_knowing_is_information(write_training, id, metrics, more):
    run = write_training(metrics, **more)
    assert ids(run) == [id]
    assert ids(run, Grade.WARNING) == []


def test_training_that_ends_before_the_last_stage_is_found(write_training):
    stages = [{"promote": {"success": 0.8}}, {}]
    run = write_training({"stage": 1}, recipe={"stages": stages})
    (finding,) = diagnose(run)
    assert (finding.id, finding.grade) == ("Q1", Grade.WARNING)
    assert finding.evidence == ["the training ended in stage 1 of 2"]
    assert f"rlctl train --resume {run.path} -n STEPS" in finding.advice[0]


def test_training_that_is_stuck_in_a_stage_is_found_while_it_goes_on(write_training):
    """Stage 1 was over after 5,000 steps; 25,000 steps of stage 2, of 30,000, had no success."""
    stages = [{"promote": {"success": 0.8}}, {"promote": {"success": 0.8}}, {}]
    metrics = {"stage": [1] * 5 + [2] * 25, "success": [0.9] * 5 + [0.0] * 25}
    run = write_training(metrics, {"success": 0.0}, {"stages": stages}, status="running")
    (finding,) = diagnose(run)
    assert (finding.id, finding.name, finding.grade) == ("Q1", "does not reach the last stage", Grade.WARNING)
    assert finding.evidence == ["no episode succeeded in stage 2 of 3, which has taken 24,000 steps"]


@pytest.mark.parametrize("metrics", [{"success": [0.9] * 5 + [0.0] * 24 + [0.02]}, {"stage": [1] * 25 + [2] * 5}])
def test_a_stage_that_is_new_or_succeeds_now_and_then_is_not_stuck(write_training, metrics):
    stages = [{"promote": {"success": 0.8}}, {"promote": {"success": 0.8}}, {}]
    metrics = {"stage": [1] * 5 + [2] * 25, "success": [0.9] * 5 + [0.0] * 25, **metrics}
    assert diagnose(write_training(metrics, {"success": 0.0}, {"stages": stages}, status="running")) == []


def test_a_policy_that_succeeds_only_while_it_explores_is_found(write_training):
    run = write_training({"success": np.tile([0.0, 0.4], 15)}, {"success": 0.0, "return": -0.5}, {"algo": "dqn"})
    (finding,) = diagnose(run)
    assert (finding.name, finding.grade) == ("succeeds only while it explores", Grade.WARNING)
    assert finding.evidence == ["success at most 0.0% in 5 evaluations, 40% while training"]


@pytest.mark.parametrize(("stage", "status"), [(2, "finished"), (1, "running"), (1, "interrupted")])
def test_stage_of_a_training_that_goes_on_is_no_finding(write_training, stage, status):
    stages = [{"promote": {"success": 0.8}}, {}]
    assert diagnose(write_training({"stage": stage}, recipe={"stages": stages}, status=status)) == []


PLACE = spaces.Box(-1.0, 1.0, (2,), np.float32)
GOALS = ENV.model_copy(
    update={
        "observation_space": space_to_json(
            spaces.Dict({"observation": PLACE, "achieved_goal": PLACE, "desired_goal": PLACE})
        ),
        "observation_sizes": {},
        "reward_weights": {},
        "has_compute_reward": True,
    }
)


def reward_goals(rewards):
    """Return an episode of a goal environment with these rewards."""
    observations = {name: np.zeros((101, 2), np.float32) for name in ("observation", "achieved_goal", "desired_goal")}
    info = EpisodeInfo(
        spec=EnvSpec("reach"), seed=1, policy="training step 1", total_reward=float(rewards.sum()), term_names=[]
    )
    return RecordedEpisode(SMOOTH.astype(np.float32), observations, rewards, np.zeros((100, 0)), info)


SPARSE = reward_goals(-1.0 * (np.arange(100) < 90))
DENSE = reward_goals(-np.linspace(1, 0, 100))


@pytest.mark.parametrize(
    ("algo", "options"),
    [("sac", "--algo sac --set her={}"), ("td3", "--algo td3 --set her={}"), ("ppo", "--algo sac --set her={}")],
)
@pytest.mark.parametrize("episodes", [[SPARSE], []])
def test_goals_that_were_trained_without_hindsight_are_found(write_training, algo, options, episodes):
    recipe = {"algo": algo, "algo_kwargs": {}}
    run = write_training({"success": 0.05}, recipe=recipe, env=GOALS, episodes=episodes)
    (finding,) = (finding for finding in diagnose(run) if finding.id == "Q14")
    assert finding.grade == Grade.WARNING
    assert f"rlctl train reach {options}" in finding.evidence[0]
    assert "success at most 5.0%" in finding.evidence


@pytest.mark.parametrize(
    ("metrics", "more"),
    [
        ({}, {}),  # succeeds
        ({"success": 0.05}, {"episodes": [DENSE]}),
        ({"success": 0.05}, {"recipe": {"algo": "sac", "algo_kwargs": {}, "her": {}}}),
        ({"success": 0.05}, {"recipe": {"algo": "sac", "algo_kwargs": {}, "reward_weights": {"alive": 2.0}}}),
        ({"success": 0.05}, {"env": GOALS.model_copy(update={"has_compute_reward": False})}),
        ({"success": 0.05}, {"env": ENV}),
    ],
)
def test_hindsight_is_suggested_only_where_it_fits(write_training, metrics, more):
    arguments = {"recipe": {"algo": "sac", "algo_kwargs": {}}, "env": GOALS, "episodes": [SPARSE], **more}
    assert "Q14" not in ids(write_training(metrics, **arguments))


def test_motion_that_no_robot_makes_is_found(write_training):
    flight = np.zeros((101, 3), np.float32)
    flight[:, 0] = 10.0 * np.arange(101)  # 10 m in 0.05 s are 200 m/s
    (finding,) = diagnose(write_training(episodes=[make_episode(SMOOTH, flight)]))
    assert finding.id == "Q8"
    assert finding.evidence == ["position moves at up to 200 m/s in a recorded episode"]


def test_bodies_that_stay_inside_each_other_are_found(write_training):
    (finding,) = diagnose(write_training(evaluations={"overlap": [0.01, 0.02, 0.2, 0.06, 0.08]}))
    assert finding.id == "Q8"
    assert finding.evidence == ["bodies overlap by 6 cm or more in half of the episodes of the last evaluations"]


def test_a_hard_landing_is_not_a_finding(write_training):
    assert diagnose(write_training(evaluations={"overlap": [0.02, 0.015, 0.02, 0.07, 0.018]})) == []


def test_badly_scaled_observations_are_found_in_a_flat_training(write_training):
    observations = np.column_stack([1e6 * np.sin(np.arange(101)), np.cos(np.arange(101)), np.zeros(101)])
    env = ENV.model_copy(update={"observation_units": {}})
    recipe = {"normalize": None}
    run = write_training(FLAT, recipe=recipe, env=env, episodes=[make_episode(SMOOTH, observations.astype(np.float32))])
    assert ids(run) == ["Q9"]


def test_show_has_findings_with_advice(write_training, rlctl):
    run = write_training({**FLAT, "explained_variance": 0.01})
    shown = rlctl("runs", "show", run.path)
    assert "warning: Q9 observations do not suffice: training return" in shown.stdout
    assert "try: Observe what the reward depends on" in shown.stdout
    assert "gamma is 0.99: usually 0.9 to 0.9999" in shown.stdout
    (finding,) = json.loads(rlctl("runs", "show", run.path, "--json", "-").stdout)["findings"]
    assert finding["id"] == "Q9"
    assert finding["grade"] == "warning"


def test_training_ends_with_warnings_in_full_and_the_rest_in_a_line(write_training):
    findings = diagnose(write_training({**FLAT, "explained_variance": 0.01, "playing": 0.1}))
    lines = format_end(findings, "runs/x")
    assert lines[0].startswith("warning: Q9 ")
    assert lines[-1] == "also noted: Q13 slow updates or a slow policy; details: rlctl runs show runs/x"
    assert format_end([], "runs/x") == []


def test_advice_has_the_recipes_value_beside_the_usual_ones(write_training):
    run = write_training({**FLAT, "approx_kl": 0.6, "clip_fraction": 0.7})
    (finding,) = (each for each in diagnose(run) if each.id == "Q3")
    settings = {each.name: each for each in finding.settings}
    assert settings["learning_rate"].value == 0.0009
    assert "1e-5 to 1e-3" in settings["learning_rate"].advice
    assert settings["clip_range"].value == 0.2  # SB3's default


def test_the_value_that_is_far_out_of_its_range_comes_first(write_training):
    recipe = {"algo_kwargs": {"learning_rate": "lin_0.03", "clip_range": 0.3, "n_epochs": 8}}
    run = write_training({**FLAT, "approx_kl": 0.6, "clip_fraction": 0.7}, recipe=recipe)
    (finding,) = (each for each in diagnose(run) if each.id == "Q3")
    assert finding.settings[0].name == "learning_rate"
    assert finding.settings[0].advice.startswith("30 times out of its usual range; usually 1e-5 to 1e-3")
    assert not any("out of its usual range" in setting.advice for setting in finding.settings[1:])


LARGE = {"approx_kl": 0.15, "clip_fraction": 0.5}


def test_a_learning_rate_far_above_the_usual_is_a_warning_though_it_learns(write_training):
    (finding,) = diagnose(write_training(LARGE, recipe={"algo_kwargs": {"learning_rate": 0.03}}))
    assert (finding.id, finding.name, finding.grade) == ("Q3", "the learning rate is very high", Grade.WARNING)
    assert finding.evidence[-1] == "learning rate 0.03"


@pytest.mark.parametrize(("metrics", "rate"), [({}, 0.03), (LARGE, 0.009)])
def test_a_high_learning_rate_or_large_updates_alone_are_no_finding(write_training, metrics, rate):
    assert diagnose(write_training(metrics, recipe={"algo_kwargs": {"learning_rate": rate}})) == []


def test_advice_names_no_parameter_that_the_algorithm_does_not_have(write_training):
    collapsed = {"return": np.concatenate([RISING[:15], np.full(15, -45.0)]), "success": None}
    finding = next(each for each in diagnose(write_training(collapsed, recipe={"algo": "sac"})) if each.id == "Q11")
    assert [each.name for each in finding.settings] == ["learning_rate"]  # SAC has no target_kl


def test_every_sign_of_a_finding_exists():
    from rlctl.runs.diagnosis.findings import _texts

    named = {name.removeprefix("not ") for each in _texts() for when in each["when"] for name in when}
    assert named <= set(list_signs())
    assert {each["id"] for each in _texts()} == {f"Q{number}" for number in range(1, 17)}


# Of PPO with a learning rate of 0.03, whose rollouts are so long that 60,000 steps are four updates.
FOUR = slice(0, 4)
COLLAPSE = {
    "return": [-369.0, -500.0, -1100.0, -1282.0],
    "approx_kl": [0.8, 1.6, 9.0, 18.4],
    "clip_fraction": 0.67,
    "success": None,
}


@pytest.mark.parametrize("more", [{}, {"status": "running", "recipe": {"total_timesteps": 400_000}}])
def test_a_collapse_is_found_after_four_updates(write_training, more):
    every = {name: np.broadcast_to(values, UPDATES)[FOUR] for name, values in HEALTHY.items() if name != "success"}
    columns = {**every, **COLLAPSE, "steps": [15_000, 30_000, 45_000, 60_000]}
    run = write_training(**more)
    _write_table(run.metrics_file, columns)
    run.evals_file.unlink()
    (finding,) = diagnose(run)
    assert (finding.id, finding.name, finding.grade) == ("Q3", "oscillates", Grade.WARNING)
    assert "return falls from -369 to -1282 at step 60,000" in finding.evidence
    _write_table(run.metrics_file, {**every, "steps": columns["steps"]})
    assert diagnose(run) == []  # the first updates of a healthy training


def test_a_return_that_falls_while_updates_are_small_is_not_called_a_collapse(write_training):
    (finding,) = diagnose(write_training({"return": -RISING, "success": None}))
    assert finding.name == "does not learn"


FLAT_SUCCESS = [0.02, 0.09, 0.2, 0.11, 0.08, 0.12]


def test_a_training_that_ends_flat_with_some_successes_is_found(write_training):
    success = np.repeat(FLAT_SUCCESS, 5)
    run = write_training({"success": success}, {"success": [0.02, 0.2, 0.08, 0.11, 0.12]})
    (finding,) = diagnose(run)
    assert (finding.id, finding.name, finding.grade) == ("Q1", "the success rate stays low", Grade.WARNING)
    assert finding.evidence == ["success 8% to 12% in the last 3 evaluations, 20% at best"]


@pytest.mark.parametrize(
    ("success", "status"),
    [
        ([0.0, 0.02, 0.05, 0.2, 0.45], "finished"),  # still rises: more steps help
        ([0.1, 0.4, 0.5, 0.6, 0.6], "finished"),
        ([0.02, 0.2, 0.08, 0.11, 0.12], "running"),
    ],
)
def test_a_success_rate_that_rises_or_may_still_rise_is_no_finding(write_training, success, status):
    recipe = {"total_timesteps": 300_000} if status == "running" else {}
    assert diagnose(write_training({"success": None}, {"success": success}, recipe, status=status)) == []


def test_a_specific_finding_replaces_the_general_one(write_training):
    run = write_training({"approx_kl": 3.0, "clip_fraction": 0.85, "success": 0.1})
    assert [finding.id for finding in diagnose(run)] == ["Q3"]


ALTERNATING = np.column_stack([SMOOTH[:, 0], 0.3 * (-1.0) ** np.arange(100)])


@pytest.mark.parametrize("status", ["finished", "running"])
def test_an_action_that_alternates_is_found_in_a_training_that_succeeds_and_at_once(write_training, status):
    recipe = {"total_timesteps": 3_000_000} if status == "running" else {}
    run = write_training(episodes=[make_episode(ALTERNATING)], recipe=recipe, status=status)
    (finding,) = diagnose(run)
    assert (finding.id, finding.name, finding.grade) == ("Q7", "alternates from step to step", Grade.WARNING)
    assert finding.evidence[0] == (
        "action 1 changes direction in 100% of the steps, on average by 0.6 of half its range (1 of 2 actions do so)"
    )


def test_a_noisy_action_and_a_fast_swing_do_not_alternate(write_training):
    noise = np.random.default_rng(0).uniform(-1, 1, 100)  # reverses in two of three steps
    swing = np.sin(np.arange(100))  # a turn in six steps
    assert diagnose(write_training(episodes=[make_episode(np.column_stack([noise, swing]))])) == []


def test_damaged_run_is_not_an_error(write_training):
    run = write_training()
    run.metrics_file.write_text("steps,return\n1,\n2,nan\nx,1\n3")
    run.recipe_file.write_text("{")
    run.last_policy.write_bytes(b"nothing")
    (run.path / "episodes").mkdir()
    run.episode_file(0).write_bytes(b"nothing")
    assert diagnose(run) == []
    run.status_file.unlink()
    assert diagnose(run) == []


def test_who_learns_to_succeed_does_not_shake_in_place(write_training):
    episodes = [make_episode(SHAKING, terms=np.tile([1.0, 0.0], (100, 1)))]
    run = write_training({"success": None}, {"success": [0.03, 0.27, 0.3, 0.4, 0.47]}, episodes=episodes)
    assert [finding.name for finding in diagnose(run)] == ["alternates from step to step"]


def test_a_finding_is_explained(rlctl):
    done = rlctl("check-env", "--explain", "q10")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Q10 ")
    assert "\n  try: " in done.stdout
    done = rlctl("check-env", "--explain", "Q99")
    assert done.returncode == 2
    assert "no finding 'Q99'" in done.stderr


DIPS = -1400 - 350 * np.sin(np.linspace(0, np.pi, UPDATES))  # as Pendulum-v1 with a gamma of 0.2
DIPS[0] = -1200


def test_a_training_that_never_rises_above_its_start_is_found(write_training):
    (finding,) = diagnose(write_training({"return": DIPS, "success": None}))
    assert (finding.id, finding.name, finding.grade) == ("Q1", "does not learn", Grade.WARNING)
    assert finding.evidence[-1] == "training return -1200 at first, -1438 at best later"


@pytest.mark.parametrize("status", [{"from": {"policy": "a.safetensors"}}, {"demos": {"path": "demos"}}])
def test_a_training_that_begins_trained_may_stay_as_it_is(write_training, status):
    assert diagnose(write_training({"return": DIPS, "success": None}, **status)) == []


def test_a_training_that_learns_at_once_and_is_flat_from_then_on_is_no_finding(write_training):
    learned = np.full(UPDATES, -150.0) + np.tile([3.0, -3.0], UPDATES // 2)
    learned[0] = -1200
    assert diagnose(write_training({"return": learned, "success": None})) == []


@pytest.mark.parametrize(
    "metrics",
    [
        {"return": DIPS, "success": None},
        {"return": np.where(np.arange(UPDATES) % 6 == 0, DIPS, np.nan), "success": None},  # of few episodes
        {"success": 0.0},  # whatever the return does
    ],
)
def test_a_training_that_learns_little_with_a_gamma_of_one_step_is_found(write_training, metrics):
    (finding,) = diagnose(write_training(metrics, recipe={"algo_kwargs": {"gamma": 0.2}}))
    assert (finding.id, finding.grade) == ("Q15", Grade.WARNING)
    assert finding.evidence[0] == "gamma 0.2: usually 0.9 to 0.9999; the policy then sees about 1 step ahead"
    assert [setting.name for setting in finding.settings] == ["gamma"]  # none that is in its usual range


def test_a_training_that_learns_with_an_unusual_value_has_no_finding(write_training):
    assert diagnose(write_training(recipe={"algo_kwargs": {"gamma": 0.2}})) == []


def test_what_follows_from_a_stronger_finding_is_one_line(write_training, rlctl):
    metrics = {**FLAT, "approx_kl": 9.0, "clip_fraction": 0.9, "explained_variance": 0.0, "action_saturation": 0.97}
    run = write_training(metrics, recipe={"algo_kwargs": {"learning_rate": 0.1}})
    lines = format_end(diagnose(run), "runs/x")
    assert lines[0].startswith("warning: Q3 oscillates")
    assert [line for line in lines if "warning:" in line] == lines[:1]
    assert not any("Q15" in line for line in lines)  # Q3 names the learning rate already
    followers = "may follow from Q3: Q9 observations do not suffice, Q12 explores too little or too much"
    assert lines[-1] == followers
    assert followers in rlctl("runs", "show", run.path).stdout.splitlines()
    assert followers in rlctl("runs", "report", run.path, "--format", "md").stdout
    assert "**Q9" not in rlctl("runs", "report", run.path, "--format", "md").stdout
