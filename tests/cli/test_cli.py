"""The command line as a user meets it: exit codes, messages, and stdout that is nothing but the result."""

import json
import os
import pty
import re
import signal
import subprocess
import sys

import pytest

import rlctl as package

PRINTING = """
    import os
    import gymnasium, numpy as np
    from gymnasium.spaces import Box
    print("printed by the import")

    class Printing(gymnasium.Env):
        observation_space, action_space = Box(-9, 9, (2,)), Box(-1, 1, (1,))

        def __init__(self, fault=""):
            self.fault = fault
            print("printed by the constructor")
            os.system("echo printed by a child")

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            print("printed by the reset")
            self.steps = 0
            return np.zeros(2, np.float32), {}

        def step(self, action):
            self.steps += 1
            if self.fault:
                raise RuntimeError(self.fault)
            return np.zeros(2, np.float32), 0.0, False, self.steps == 4, {"is_success": True}
"""


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A policy file for the environment above, with the weights it was born with."""
    from gymnasium.spaces import Box

    from rlctl.environments.info import EnvInfo, space_to_json
    from rlctl.environments.spec import EnvSpec
    from rlctl.policy.file import PolicyFile, PolicyInfo
    from rlctl.policy.torch_policy import build_network

    env = EnvInfo(
        observation_space=space_to_json(Box(-9, 9, (2,))),
        action_space=space_to_json(Box(-1, 1, (1,))),
    )
    info = PolicyInfo(algo="ppo", policy="MlpPolicy", env=env, spec=EnvSpec("printing.py:Printing"))
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    PolicyFile(info, {f"policy/{k}": v.numpy() for k, v in build_network(info).state_dict().items()}).write(path)
    return path


@pytest.fixture
def printing(write_module):
    return write_module("printing.py", PRINTING)


def test_version(installed_rlctl):
    result = installed_rlctl("--version")
    assert (result.returncode, result.stdout, result.stderr) == (0, f"rlctl {package.__version__}\n", "")


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("arguments", [["-h"], ["--help"], ["train", "-h"], ["eval", "--help"]])
def test_help(rlctl, arguments):
    result = rlctl(*arguments)
    assert result.returncode == 0
    assert "Usage: " in result.stdout
    assert result.stderr == ""


def test_no_arguments_show_the_help(rlctl):
    result = rlctl()
    assert result.returncode == 2
    for verb in ("check-env", "train", "eval", "export", "replay", "tasks"):
        assert verb in result.stdout + result.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["evil"], 2, "No such command 'evil'. Did you mean 'eval'?"),
        (["tasks", "--chek"], 2, "No such option: --chek"),
        (["eval", "--episodes", "0"], 2, "Invalid value for '--episodes': Input should be greater than or equal to 1"),
        (
            ["runs", "--sort", "stepz"],
            2,
            "Invalid value for '--sort': 'stepz' is not one of 'newest', 'score', 'steps', 'minutes'",
        ),
        (
            ["runs", "report", "latest", "--format", "txt"],
            2,
            "Invalid value for '--format': 'txt' is not one of 'html', 'md', 'table', 'csv', "
            "'latex', 'svg', 'pdf', 'png'",
        ),
        (
            ["runs", "compare", "a", "b", "--gate", "worse"],
            2,
            "Invalid value for '--gate': 'worse' is not one of 'not-worse', 'better'",
        ),
        (
            ["check-env", "reach", "--format", "xml"],
            2,
            "Invalid value for '--format': 'xml' is not one of 'text', 'json', 'sarif', 'junit', 'github'",
        ),
        (["train", "reech"], 2, "error: no task 'reech'. Did you mean 'reach'? Installed: "),
        (["train", ""], 2, "error: no task ''. Installed: "),
        (["train"], 2, "error: neither TASK nor --resume is given: give a task to train, or a run to resume"),
        (["train", "reach", "--algo", "pppo"], 2, "error: algo: expected ppo or a2c or "),
        (["train", "reach", "--set", "n_env=3"], 2, "error: no key 'n_env'. Did you mean 'n_envs'?"),
        (
            ["train", "reach", "--set", "algo_kwargs.learning_rate=3"],
            2,
            "error: algo_kwargs.learning_rate: ",
        ),
        (
            ["train", "reach", "-n", "0"],
            2,
            "error: total_timesteps: expected a whole number in [1, 1e12], ",
        ),
        (["eval", "--set", "seed=1"], 2, "error: --set seed: only task.NAME, reward_weights.NAME, randomize, "),
        (["export"], 5, "error: no run yet under "),
        (
            ["train", "reach", "--device", "gpu"],
            2,
            "error: --device 'gpu': no such device; give cpu, cuda, cuda:1, or ",
        ),
        (["eval", "--min-success", "95"], 2, "error: --min-success 95: a rate is between 0 and 1; 95 % is 0.95"),
        (["train", "two.py"], 2, "error: no task 'two.py' is installed; to name a class in two.py: two.py:Swing or "),
        (["train", "Two"], 2, "error: no task 'Two' is installed; to name a class in two.py: two.py:Swing or two.py:"),
        (["eval", "--episodes", "99999999999"], 2, "Invalid value for '--episodes'"),
        (["tune", "--resume", "latest"], 5, "error: latest: not the folder of a tuning: it has no tune.json"),
        (["runs", "report"], 5, "error: no run yet under "),
        (["runs", "reach"], 5, "error: no run of 'reach' under "),
        (["eval", "model.zip"], 5, "error: model.zip: a .zip, the model format of Stable-Baselines3, not a run"),
        (["train", "broken.py:Env"], 3, "error: task 'broken.py:Env': import failed: RuntimeError: no robot (broken."),
        (["eval"], 5, "error: no run yet under "),
        (["eval", ""], 5, "error: no run '': neither a folder nor a task with a run"),
        (["eval", "reach"], 5, "error: no run of 'reach' yet under "),
        (["eval", "missing.safetensors"], 5, "error: missing.safetensors: no such file"),
        (["train", "reach", "--config", "missing.yaml"], 5, "error: no recipe file missing.yaml"),
        (["tasks", "--json", "broken.py/x.json"], 5, "error: broken.py"),
    ],
)
def test_errors_are_a_line_and_a_code(rlctl, write_module, arguments, code, message):
    write_module("broken.py", "raise RuntimeError('no robot')")
    write_module("two.py", "class Swing(Task): ...\nclass _Own(Task): ...\nclass Twirl(gym.Env): ...\nclass Other: ...")
    result = rlctl(*arguments)
    assert result.returncode == code, result.stderr
    lines = result.stderr.splitlines()
    assert any(line.startswith(f"error: {message.removeprefix('error: ')}") for line in lines), result.stderr
    assert len(lines) <= 3 or code == 3  # with the plugin's traceback
    assert result.stdout == ""
    assert "site-packages" not in result.stderr


@pytest.mark.slow
def test_underscores_are_read_as_dashes(rlctl):
    result = rlctl("eval", "--env_timeout", "5", "--num-envs", "2", "--num_envs", "3", "--min_success", "0.5")
    assert "no run yet" in result.stderr
    assert rlctl("check_env", "reech").returncode == 2


@pytest.mark.slow
def test_a_plugins_traceback_stands_above_the_error(installed_rlctl, write_module):
    write_module("broken.py", "raise RuntimeError('no robot')")
    *above, last = installed_rlctl("train", "broken.py:Env").stderr.splitlines()
    assert last == "error: task 'broken.py:Env': import failed: RuntimeError: no robot (broken.py:1)"
    assert above[0] == "Traceback (most recent call last):"
    assert any("broken.py" in line for line in above)


@pytest.mark.slow
def test_json_goes_to_a_file_besides(rlctl, tmp_path):
    result = rlctl("tasks", "--json", "deep/tasks.json")
    assert (result.returncode, result.stdout) == (0, rlctl("tasks").stdout)
    content = json.loads((tmp_path / "deep/tasks.json").read_text())
    (reach,) = [task for task in content["tasks"] if task["name"] == "reach"]
    assert reach["target"] == "rlctl_manipulation.reach:Reach"
    assert (reach["distribution"], reach["version"]) == ("rlctl", package.__version__)
    assert (reach["algo"], reach["problem"]) == ("ppo", None)


def test_a_failure_replaces_the_result_of_an_earlier_call(rlctl, tmp_path):
    file = tmp_path / "result.json"
    file.write_text('{"success_rate": 1.0}')
    assert rlctl("eval", "nowhere", "--json", str(file)).returncode == 5
    failure = json.loads(file.read_text())
    assert (failure["format"], failure["exit_code"]) == ("rlctl error 1", 5)
    assert failure["error"].startswith("no run 'nowhere'")


def test_stdout_is_nothing_but_the_json(rlctl, printing, policy):
    result = rlctl("eval", policy, "--episodes", "3", "--n-envs", "2", "--json", "-")
    assert result.returncode == 0, result.stderr
    content = json.loads(result.stdout)
    assert content["success_rate"] == 1.0
    assert len(content["episodes"]) == 3
    for who in ("import", "constructor", "reset"):
        assert f"printed by the {who}" in result.stderr
    assert "printed by a child" in result.stderr


def test_an_environment_that_fails_in_an_evaluation(rlctl, printing, policy):
    result = rlctl("eval", policy, "--episodes", "2", "--n-envs", "1", "--set", "task.fault=motors off")
    assert result.returncode == 3
    *_, message, place = result.stderr.splitlines()
    assert message == "error: task 'printing.py:Printing': RuntimeError: motors off"
    assert re.fullmatch(
        r"in environment 0, episode seed \d+, step 1; to see it alone: rlctl check-env printing.py:Printing", place
    )
    assert result.stdout == ""


@pytest.mark.slow_except(first=1)
@pytest.mark.parametrize("arguments", [["tasks"], ["tasks", "--json", "-"], ["--help"], ["--version"]])
def test_a_closed_stdout_ends_quietly(rlctl, arguments):
    read_end, write_end = os.pipe()
    os.close(read_end)
    result = rlctl(*arguments, stdout=write_end)
    os.close(write_end)
    assert (result.returncode, result.stderr) == (141, "")


@pytest.mark.slow
@pytest.mark.parametrize(("variable", "coloured"), [({}, True), ({"NO_COLOR": "1"}, False)])
def test_colours_are_for_terminals_and_can_be_refused(install, tmp_path, variable, coloured):
    site = install("some-robots", {"absent": "some_robots.absent:Task"})  # a problem, shown in red
    environment = {name: value for name, value in os.environ.items() if name != "NO_COLOR"}
    environment |= {"TERM": "xterm-256color", "PYTHONPATH": str(site), **variable}
    ours, terminal = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "rlctl", "tasks"], stdout=terminal, stderr=terminal, env=environment, cwd=tmp_path
    ) as process:
        os.close(terminal)
        seen = b"".join(iter(lambda: read(ours), b""))
    os.close(ours)
    assert process.returncode == 0
    assert b"missing" in seen
    assert (b"\x1b[31m" in seen) == coloured


def read(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, 4096)
    except OSError:  # how Linux reports that the other end of a terminal has closed
        return b""


def test_piped_output_is_plain(rlctl):
    assert "\x1b" not in rlctl("tasks", env={"NO_COLOR": ""}).stdout


@pytest.mark.slow
def test_ctrl_c(tmp_path, write_module):
    write_module("slow.py", "import time\nprint('importing', flush=True)\ntime.sleep(60)\n")
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from rlctl.cli import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "train", "slow.py:Env"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr.readline() == "importing\n"
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in err


def test_a_bug_shows_its_traceback(rlctl, tmp_path):
    code = (
        "import sys; from rlctl.tasks import listing; listing.list_tasks = lambda check: 1 / 0; "
        "from rlctl.cli import main; sys.argv[1:] = ['tasks']; main()"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 70
    assert "ZeroDivisionError: division by zero" in result.stderr
    assert result.stderr.splitlines()[-1].startswith(f"error: a bug in rlctl {package.__version__} or a library; ")


@pytest.mark.slow
def test_an_exit_handler_that_hangs_does_not_keep_the_process(tmp_path):
    code = (
        "import atexit, sys, time; from rlctl import cli; from rlctl.processes import error_boundary\n"
        "error_boundary.EXIT_S = 0.2\n"
        "atexit.register(time.sleep, 100); sys.argv[1:] = ['reech']; cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=250)
    assert done.returncode == 2
    assert done.stderr.endswith("warning: an exit handler did not finish within 0.2 s; exiting without it\n")


@pytest.mark.parametrize(
    ("option", "setting"),
    [("--lr", "algo_kwargs.learning_rate"), ("--normalize", "normalize"), ("--gamma", "algo_kwargs.gamma")],
)
def test_an_option_that_is_a_key_of_the_recipe(rlctl, option, setting):
    result = rlctl("train", "reach", option, "0.1")
    assert result.returncode == 2
    assert f"error: no option {option}; set the recipe's key instead: --set {setting}=VALUE" in result.stderr


def test_resuming_a_task_without_a_run(rlctl):
    result = rlctl("train", "--resume", "reach")
    assert result.returncode == 5
    assert "to use the policy that it ships: rlctl train reach --from reach" in result.stderr
    assert "--pretrained" not in result.stderr
