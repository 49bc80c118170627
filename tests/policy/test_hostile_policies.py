"""Policy files that somebody may send: their description must not cost more than the file, and must be possible."""

import json
import struct
import time

import numpy as np
import pytest
from gymnasium import spaces
from safetensors.numpy import load_file, save

from rlctl import load_policy
from rlctl.environments.info import EnvInfo, space_to_json
from rlctl.environments.spec import EnvSpec
from rlctl.errors import ArtifactError, RlctlError
from rlctl.policy.c_policy import CActor
from rlctl.policy.file import PolicyFile, PolicyInfo, compute_digest
from rlctl.policy.torch_policy import TorchActor, build_network

BOX = spaces.Box(-np.inf, np.inf, (5,), np.float32)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    env = EnvInfo(observation_space=space_to_json(BOX), action_space=space_to_json(spaces.Box(-1.0, 1.0, (2,))))
    info = PolicyInfo(
        algo="ppo", policy="MlpPolicy", env=env, spec=EnvSpec("my_env.py:MyEnv"), policy_kwargs={"net_arch": [8]},
        clip_observation=10.0, normalized_keys=[""],
    )  # fmt: skip
    tensors = {f"policy/{key}": value.numpy() for key, value in build_network(info).state_dict().items()}
    path = tmp_path_factory.mktemp("good") / "policy.safetensors"
    PolicyFile(info, {**tensors, "normalize//mean": np.zeros(5), "normalize//var": np.ones(5)}).write(path)
    return path


@pytest.fixture
def changed(good, tmp_path):
    """Write a policy file with another description, which is data or text, or other tensors."""

    def change(description=None, **tensors):
        path = tmp_path / "policy.safetensors"
        info = json.loads(PolicyInfo.model_dump_json(load_policy(good).info)) if description is None else description
        text = info if isinstance(info, str) else json.dumps(info)
        content = {**load_file(good), **tensors}
        path.write_bytes(save(content, metadata={"rlctl": text, "sha256": compute_digest(text, content)}))
        return path

    return change


@pytest.fixture
def described(good):
    return json.loads(load_policy(good).info.model_dump_json())


def refused(path, load=load_policy):
    """What is said of a file that is refused: at once, in one line."""
    began = time.process_time()
    with pytest.raises(RlctlError) as caught:
        load(path)
    assert caught.value.exit_code == 5
    assert time.process_time() - began < 10
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message


def test_the_good_one_is_good(good):
    assert load_policy(good).predict(np.zeros(5)).shape == (2,)


def nested(depth):
    space = {"type": "Discrete", "n": 2, "start": 0}
    for _ in range(depth):
        space = {"type": "Dict", "spaces": {"a": space}}
    return space


BOX_DATA = {"type": "Box", "low": "-1.0", "high": "1.0", "dtype": "float32"}


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"net_arch": [10**30]}, "its tensors do not fit its description: "),
        ({"net_arch": [-1]}, "its tensors do not fit its description: "),
        ({"net_arch": "wide"}, "its tensors do not fit its description: "),
        ({"features_extractor_class": "os.system"}, "its tensors do not fit its description: "),
        ({"optimizer_class": "os.system"}, "its tensors do not fit its description: "),
        ({"activation_fn": ["tanh"]}, "its tensors do not fit its description: "),
        ({"log_std_init": "x"}, "its tensors do not fit its description: "),
    ],
)
def test_a_network_of_another_size(kwargs, message, changed, described):
    assert message in refused(changed({**described, "policy_kwargs": kwargs}), TorchActor.load)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({**BOX_DATA, "shape": [10**12]}, "1,000,000,000,000 elements, at most 10,000,000 are supported"),
        ({**BOX_DATA, "shape": [10**6, 10**6]}, "1,000,000,000,000 elements, at most "),
        ({**BOX_DATA, "shape": [-1]}, "not a space: shape [-1]"),
        ({**BOX_DATA, "shape": [1] * 65}, "not a space: maximum supported dimension for an ndarray is "),
        ({**BOX_DATA, "shape": [True]}, "not a space: expected a whole number, got True"),
        ({**BOX_DATA, "shape": [5], "dtype": "O"}, "not a space: a Box of object"),
        ({**BOX_DATA, "shape": [5], "low": ["1.0"]}, "not a space: "),
        ({**BOX_DATA, "shape": [4]}, "its tensors do not fit its description: "),
        ({"type": "Discrete", "n": 10**18, "start": 0}, "elements, at most 10,000,000 are supported"),
        ({"type": "Discrete", "n": 0, "start": 0}, "not a space: "),
        ({"type": "MultiDiscrete", "nvec": [10**18]}, "elements, at most 10,000,000 are supported"),
        ({"type": "MultiBinary", "n": 10**12}, "elements, at most 10,000,000 are supported"),
        (
            {"type": "Dict", "spaces": {str(n): {**BOX_DATA, "shape": [10**6]} for n in range(20)}},
            "20,000,000 elements",
        ),
        ({"type": "Dict", "spaces": []}, "not a space: "),
        ({"type": ["Box"]}, "not a space: "),
        (nested(30), "its tensors do not fit its description: "),
        (nested(400), "damaged: nested too deeply"),
    ],
)
def test_a_space_that_cannot_be(space, message, changed, described):
    described["env"]["observation_space"] = space
    assert message in refused(changed(described))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "damaged: nested too deeply"),
        ('{"format": ' + "9" * 10_000 + "}", "damaged: Exceeds the limit"),
        ("", "damaged: Expecting value"),
        ("null", "damaged: expected a mapping of "),
        ('{"\\ud800": 0}', "damaged: 'utf-8' codec can't encode"),
        ('{"format": 1, "algo": ["\\udfff"]}', "damaged: 'utf-8' codec can't encode"),
        ('{"format": "x"}', "damaged: format: expected a whole number, got 'x'"),
    ],
)
def test_a_description_that_is_none(text, message, changed):
    assert message in refused(changed(text))


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({"policy/log_std": np.full(2, np.nan, np.float32)}, "damaged: policy/log_std is not finite"),
        ({"normalize//var": np.full(5, np.inf)}, "damaged: normalize//var is not finite"),
        ({"normalize//mean": np.zeros(1)}, "normalize//mean has shape (1,), the observation (5,)"),
        ({"normalize//var": np.full(5, -1.0)}, "its tensors do not fit its description: "),
        ({"policy/log_std": np.zeros(3, np.float32)}, "its tensors do not fit its description: "),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value encountered in sqrt")
def test_tensors_that_cannot_be(tensors, message, changed):
    assert message in refused(changed(**tensors))


def test_a_tensor_of_no_network(changed):
    path = changed(**{"policy/more": np.zeros(3, np.float32)})
    assert "its tensors do not fit its description: tensors missing: [], unknown: ['more']" in refused(
        path, TorchActor.load
    )
    assert load_policy(path).predict(np.zeros(5)).shape == (2,)


@pytest.mark.slow
@pytest.mark.parametrize("value", [None, -1, "x", [], {}, 10**30])
def test_any_value_at_any_place(value, changed, described):
    """Refused in a line, or of no consequence; whatever it is, no other exception."""
    good, lines = 0, []
    mutated = [{**described, key: value} for key in described]
    for part in ("env", "spec"):
        mutated += [{**described, part: {**described[part], key: value}} for key in described[part]]
    for description in mutated:
        path = changed(description)
        try:
            load_policy(path)
            good += 1
        except RlctlError as error:
            lines.append((error.exit_code, len(str(error).splitlines())))
    assert set(lines) == {(5, 1)}
    assert good < len(mutated) // 2  # `{}` is valid wherever a mapping is


def written(path, head, rest=b""):
    path.write_bytes(struct.pack("<Q", len(head)) + head + rest)
    return path


def test_a_header_that_lies(tmp_path, good):
    path, lie = tmp_path / "x.safetensors", "damaged, or not a .safetensors file: "
    path.write_bytes(struct.pack("<Q", 2**63) + good.read_bytes()[8:])
    assert f"{lie}Error while deserializing header: header too large" in refused(path)
    tensor = {"a": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4 * 10**12]}}
    assert lie in refused(written(path, json.dumps(tensor).encode()))
    overlap = {name: {"dtype": "F32", "shape": [4], "data_offsets": [0, 16]} for name in "ab"}
    assert lie in refused(written(path, json.dumps(overlap).encode(), bytes(16)))
    assert lie in refused(written(path, b"[" * 100_000))


def test_a_header_of_a_hundred_megabytes(tmp_path):
    path = tmp_path / "x.safetensors"
    path.write_bytes(struct.pack("<Q", 10**8 + 1))
    with path.open("r+b") as file:
        file.truncate(10**8 + 9)  # takes no space on the disk
    assert "header too large" in refused(path)


def test_a_file_larger_than_memory(tmp_path):
    path = tmp_path / "x.safetensors"
    with path.open("wb") as file:
        file.truncate(2**43)  # 8 TB, and no space on the disk
    assert "too large: it needs 8.8 TB of memory, and " in refused(path)


def test_a_compiled_policy_with_a_wrong_description(tmp_path):
    (tmp_path / "policy.so").write_bytes(b"")
    description = tmp_path / "policy.json"
    description.write_text('{"format": 1, "algo": 3}')
    with pytest.raises(ArtifactError, match=r"policy.json: damaged: algo: expected text, got 3$"):
        CActor.load(tmp_path / "policy.so")
