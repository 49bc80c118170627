"""From a policy file to a verified ONNX file, in the policy's own environment."""

import dataclasses
import json
import shutil

import numpy as np
import onnx
import pytest
import torch

from rlctl.environments.spec import EnvSpec
from rlctl.errors import AnswerIsNo, ArtifactError, UsageError
from rlctl.exporting.export import export_policy
from rlctl.exporting.export_request import ExportRequest
from rlctl.exporting.report import format_closed_loop, show
from rlctl.exporting.verify import Comparison, compare_episodes, verify
from rlctl.play.collect import Episode
from rlctl.play.messages import EpisodeResult
from rlctl.play.workers import Workers
from rlctl.policy.actor import Rows
from rlctl.policy.file import PolicyFile
from rlctl.policy.onnx_policy import OnnxActor
from rlctl.policy.torch_policy import TorchActor


def export(path, output=None, formats=("onnx",)):
    (report,) = export_policy(ExportRequest(str(path), tuple(formats), "best", output))
    return report


def assert_verified(report):
    assert report.path.is_file()
    assert report.agreement.observations >= 1000
    assert report.agreement.max_difference <= 1e-5
    assert report.agreement.beyond_limit == 0
    loop = report.closed_loop
    assert loop.same_success in (None, 20)  # None where the environment reports none
    assert loop.same_length == loop.episodes == 20
    assert loop.max_return_difference <= 1e-3


# Takes seconds, and runs in every `make test`: an export acts as its policy.
@pytest.mark.slow_except("sac-vector-matrix")
@pytest.mark.parametrize(
    ("algo", "observation", "action"),
    [
        ("ppo", "dict", "box"),
        pytest.param("a2c", "vector", "multidiscrete", marks=pytest.mark.slow),
        ("sac", "vector", "matrix"),
        pytest.param("td3", "double", "box", marks=pytest.mark.slow),
        pytest.param("crossq", "vector", "box", marks=pytest.mark.slow),
        pytest.param("xqc", "vector", "box", marks=pytest.mark.slow),
        ("recurrent_ppo", "vector", "box"),
    ],
)
def test_export_is_verified(algo, observation, action, small, train, write):
    spec = small(observation, action)
    model = train(algo, spec)
    if model.get_vec_normalize_env() is not None and observation == "vector":
        model.get_vec_normalize_env().obs_rms.var[0] = 1e-12
    path = write(model, algo, spec)
    report = export(path)
    assert report.path == path.with_suffix(".onnx")
    assert report.size == report.path.stat().st_size
    assert_verified(report)
    assert sorted(file.name for file in path.parent.iterdir()) == ["policy.onnx", "policy.safetensors"]


@pytest.mark.parametrize(
    ("algo", "task"),
    [
        pytest.param("ppo", "reach", marks=pytest.mark.slow),
        pytest.param("sac", "Pendulum-v1", marks=pytest.mark.slow),
        pytest.param("dqn", "CartPole-v1", marks=pytest.mark.slow),
    ],
)
def test_export_of_known_tasks(algo, task, train, write):
    spec = EnvSpec(task)
    report = export(write(train(algo, spec), algo, spec))
    assert_verified(report)
    assert report.latency.speedup > 0  # 9 to 15 on an idle machine


@pytest.mark.slow
def test_more_rollouts_where_episodes_are_short(small, train, write):
    report = export(write(train("ppo", small(), steps=0), "ppo", small()))
    # 20 episodes of 20 steps are not enough; so many more are played that 1,000 observations are reached.
    assert 1000 <= report.agreement.observations <= 1200


@pytest.mark.slow
def test_run_gets_it_into_its_exports(small, train, write, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    policies = tmp_path / "runs" / "reach" / "2026-11-21_10-30-00_s0" / "policies"
    policies.mkdir(parents=True)
    shutil.copy(write(train("ppo", small(), steps=0), "ppo", small()), policies / "best.safetensors")
    (policies.parent / "run.json").write_text(json.dumps({"task": "reach"}))
    (report,) = export_policy(ExportRequest(str(policies.parent), ("onnx",), "best", None))
    assert report.path == policies.parent / "exports" / "policy.onnx"
    with pytest.raises(ArtifactError, match="no last policy yet"):
        export_policy(ExportRequest(None, ("onnx",), "last", None))
    shutil.move(report.path.parent, tmp_path / "elsewhere")
    report.path.parent.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ArtifactError, match="exports: a symbolic link out of the run's folder; remove it"):
        export_policy(ExportRequest(str(policies.parent), ("onnx",), "best", None))


def write_policy_of_rounding_errors(train, write, spec):
    """Write a policy whose actions are sums of large numbers that cancel: the order of the additions decides them."""
    model = train("ppo", spec, steps=0, policy_kwargs={"net_arch": [256]})
    hidden, outputs = model.policy.mlp_extractor.policy_net[0], model.policy.action_net
    order = torch.randperm(256, generator=torch.Generator().manual_seed(0))
    positive, negative = order[:128], order[128:]
    hidden.weight.data[negative], hidden.bias.data[negative] = hidden.weight.data[positive], hidden.bias.data[positive]
    outputs.weight.data[:, positive], outputs.weight.data[:, negative] = 1e6, -1e6
    return write(model, "ppo", spec)


def test_not_verified_is_not_kept(small, train, write, tmp_path):
    path = write_policy_of_rounding_errors(train, write, small())
    target = tmp_path / "out" / "policy.onnx"
    target.parent.mkdir()
    target.write_bytes(b"former")
    with pytest.raises(AnswerIsNo, match="not verified, not written") as raised:
        export(path, target)
    first, agreement, loop = str(raised.value).splitlines()
    assert first.startswith(f"{target}: ")
    assert first.endswith(f"it does not act as {path} does")
    assert "actions beyond the limit" in agreement
    assert loop.startswith("20 episodes: ")
    assert [file.name for file in target.parent.iterdir()] == ["policy.onnx"]
    assert target.read_bytes() == b"former"


@pytest.mark.slow
def test_an_environment_that_magnifies_rounding_is_verified_by_its_actions(small, train, write):
    spec = small(factor=100.0)
    report = export(write(train("ppo", spec, steps=0), "ppo", spec))
    assert report.agreement.beyond_limit == 0
    assert report.closed_loop.magnified
    assert not report.closed_loop.agrees
    text = format_closed_loop(report.closed_loop)
    assert text.endswith(
        "; the episodes are chaotic: a change in the last bits makes the original policy differ as much"
    )


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [{"noise": 0.1}, {"keeps": True}])
@pytest.mark.parametrize("algo", ["ppo", "recurrent_ppo"])
def test_an_environment_that_does_not_repeat_its_episodes_is_verified_by_actions(algo, parameters, small, train, write):
    spec = small(**parameters)
    report = export(write(train(algo, spec, steps=0), algo, spec))
    assert report.path.is_file()
    assert report.agreement.agrees
    assert not report.closed_loop.repeats
    assert not report.closed_loop.magnified
    expected = "cannot be compared: the environment does not repeat its own episodes (check-env)"
    assert ("closed loop", expected) in report.list_rows()
    assert report.as_json()["verified"] is True
    assert report.as_json()["closed_loop"]["repeats"] is False


@pytest.mark.slow
def test_other_actions_are_noticed_where_episodes_do_not_repeat(small, train, write):
    path = write_policy_of_rounding_errors(train, write, small(noise=0.1))
    with pytest.raises(AnswerIsNo, match="it does not act as"):
        export(path)


@pytest.mark.slow
def test_other_weights_are_noticed(small, train, write, tmp_path):
    model = train("ppo", small())
    original = write(model, "ppo", small())
    model.policy.action_net.bias.data[0] += 0.001
    exported = export(write(model, "ppo", small(), name="other")).path
    with Workers(small(), 10) as workers:
        agreement, _ = verify(TorchActor.load(original), OnnxActor.load(exported), exported, workers)
    assert not agreement.agrees
    assert agreement.max_difference == pytest.approx(0.001, rel=0.01)
    assert agreement.beyond_limit > 1000


def logits_policy(train, write, small, action, logits):
    """A policy whose logits are the same for every observation."""
    spec = small(action=action)
    model = train("ppo", spec, steps=0)
    model.policy.action_net.weight.data.zero_()
    model.policy.action_net.bias.data[:] = model.policy.action_net.bias.data.new_tensor(logits)
    return TorchActor.load(write(model, "ppo", spec))


@pytest.mark.slow_except(first=2)
@pytest.mark.parametrize(
    ("action", "logits", "other", "near_tie"),
    [
        ("discrete", [0.5, 0.500004, 0.4, 0.0], [0], True),
        ("discrete", [0.5, 0.50004, 0.4, 0.0], [0], False),
        ("multidiscrete", [0.0, 1.0, 2.0, 2.000001, 0.0, 0.0, 0.0, 0.0, 1.0], [[1, 0, 3]], True),
        ("multidiscrete", [0.0, 1.0, 2.0, 2.000001, 0.0, 0.0, 0.0, 0.0, 1.0], [[0, 0, 3]], False),
        ("multibinary", [1e-6, -1.0, 1.0], [[0, 0, 1]], True),
        ("multibinary", [1e-6, -1.0, 1.0], [[0, 1, 1]], False),
    ],
)
def test_only_near_ties_may_be_chosen_differently(action, logits, other, near_tie, small, train, write):
    policy = logits_policy(train, write, small, action, logits)
    comparison = Comparison(policy, policy)
    expected = policy.act(np.zeros((1, 3), np.float32), Rows.one())[1]
    comparison.add(expected, np.array(other))
    seen = comparison.agreement
    assert (seen.near_ties, seen.beyond_limit) == ((1, 0) if near_tie else (0, 1))
    assert seen.agrees == near_tie


def test_not_a_number_is_beyond_the_limit(small, train, write):
    policy = TorchActor.load(write(train("ppo", small(), steps=0), "ppo", small()))
    comparison = Comparison(policy, policy)
    comparison.add(np.zeros((2, 2), np.float32), np.array([[np.nan, 0.0], [0.0, 0.0]], np.float32))
    assert comparison.agreement.beyond_limit == 1


def test_episodes_are_compared_in_numbers():
    def episodes(*results):
        return [
            Episode(EpisodeResult(0, index, total, length, success, {}, None))
            for index, (total, length, success) in enumerate(results)
        ]

    ours = episodes((-10.0, 20, True), (0.0, 20, True), (-20.0, 20, None))
    theirs = episodes((-10.0, 20, True), (0.02, 19, False), (-20.0, 20, None))
    loop = compare_episodes(ours, theirs)
    assert (loop.episodes, loop.same_length, loop.same_success) == (3, 2, 2)
    # The mean size of the six returns is 60.02 / 6; 0.02 of that is 0.2 %.
    assert loop.max_return_difference == pytest.approx(0.02 / (60.02 / 6))
    assert not loop.agrees
    assert compare_episodes(ours, ours).agrees
    assert format_closed_loop(loop).startswith("3 episodes: same success in 2, same length in 2, return within ")


def test_success_is_not_compared_where_there_is_none():
    episodes = [Episode(EpisodeResult(0, index, 1.0, 20, None, {}, None)) for index in range(3)]
    loop = compare_episodes(episodes, episodes)
    assert loop.agrees
    assert format_closed_loop(loop) == "3 episodes: same length in 3, return within 0.0e+00 (mean 1 and 1)"


def test_environment_that_is_gone(small, train, write, tmp_path):
    file = tmp_path / "gone.py"
    shutil.copy(small().task.rpartition(":")[0], file)
    spec = EnvSpec(f"{file}:Small")
    path = write(train("ppo", spec, steps=0), "ppo", spec)
    file.unlink()
    with pytest.raises(UsageError, match=r"cannot be verified, because its environment does not build: .*no file"):
        export(path)
    assert not path.with_suffix(".onnx").exists()


def test_environment_that_has_changed(small, train, write, tmp_path):
    file = tmp_path / "changed.py"
    shutil.copy(small().task.rpartition(":")[0], file)
    spec = EnvSpec(f"{file}:Small")
    path = write(train("ppo", spec, steps=0), "ppo", spec)
    file.write_text(file.read_text().replace("np.inf, (3,), np.float32)", "np.inf, (4,), np.float32)  # changed"))
    with pytest.raises(ArtifactError, match=r"its environment has changed: its observation space is .*\(3,\)"):
        export(path)


@pytest.mark.parametrize("name", ["policy.bin", "folder"])
def test_output_must_be_called_onnx(name, small, train, write, tmp_path):
    path = write(train("ppo", small(), steps=0), "ppo", small())
    with pytest.raises(UsageError, match=r"give a name that ends in \.onnx"):
        export(path, tmp_path / name)


def test_onnx_file_is_not_exported_again(tmp_path):
    (tmp_path / "policy.onnx").write_bytes(b"")
    with pytest.raises(UsageError, match="is an ONNX file already"):
        export(tmp_path / "policy.onnx")


@pytest.mark.slow
def test_command_line(rlctl, small, train, write, tmp_path):
    spec = small()
    path = write(train("ppo", spec), "ppo", spec)
    done = rlctl("export", path.name, "--onnx", "-o", "x.onnx", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line.split("  ")[0].strip() for line in lines] == [
        "exported", "policy", "inputs", "outputs", "verified", "closed loop", "latency", "next",
    ]  # fmt: skip
    assert "obs float[batch, 3]" in lines[2]
    assert "max |difference| " in lines[4]
    assert " us for one observation; SB3 " in lines[6]
    onnx.checker.check_model(onnx.load(tmp_path / "x.onnx"), full_check=True)
    done = rlctl("export", path.name, "--onnx", "-o", "x.onnx", "--json", "-", cwd=tmp_path)
    result = json.loads(done.stdout)
    assert result["verified"] is True
    assert result["max_difference"] <= 1e-5
    assert result["observations"] >= 1000
    assert result["inputs"] == [{"name": "obs", "dtype": "float", "shape": ["batch", 3]}]


@pytest.mark.slow
def test_a_file_of_another_policy_next_to_the_exported_one_is_named(rlctl, small, train, write, tmp_path):
    spec = small()
    path = write(train("ppo", spec), "ppo", spec)
    assert rlctl("export", path.name, "--c", "--onnx", cwd=tmp_path).returncode == 0
    assert "warning" not in rlctl("export", path.name, "--onnx", cwd=tmp_path).stderr  # the C file is of this policy
    policy = PolicyFile.read(path)
    tensors = {name: 0.9 * values for name, values in policy.tensors.items()}
    dataclasses.replace(policy, tensors=tensors).write(path)
    done = rlctl("export", path.name, "--onnx", cwd=tmp_path)
    assert done.returncode == 0
    assert f"warning: {path.stem}.c was not written now, and is of another policy than {path.stem}.onnx" in done.stderr
    assert "warning" not in rlctl("export", path.name, "--c", cwd=tmp_path).stderr


@pytest.mark.slow
def test_command_line_when_the_answer_is_no(rlctl, small, train, write, tmp_path):
    path = write_policy_of_rounding_errors(train, write, small())
    done = rlctl("export", path.name, "--onnx", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("error: policy.onnx: not verified, not written: ")
    assert not path.with_suffix(".onnx").exists()


@pytest.mark.slow
def test_report_as_json_file(small, train, write, tmp_path):
    spec = small()
    report = export(write(train("ppo", spec, steps=0), "ppo", spec))
    show([report], str(tmp_path / "report.json"))
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["closed_loop"]["episodes"] == 20
    assert content["agreement"]["batch_sizes"] == [1, 20]
    assert content["latency"]["speedup"] == pytest.approx(report.latency.speedup)
