"""Runs at addresses: pushed, fetched once, checked by content, over memory and an S3 server on loopback."""

import hashlib
import json
import sys

import fsspec
import pytest

import rlctl
from rlctl.errors import ArtifactError, UsageError
from rlctl.hub import store
from rlctl.policy.file import PolicyFile
from rlctl.runs.lookup import find_policy, find_run, locate_task
from rlctl.runs.push import push_run
from rlctl.storage import files
from tests.robot.serve.serving import write_policy

ADDRESS = "memory://lab/reach"
STATUS = {"task": "reach", "status": "finished", "source_sha256": None}


@pytest.fixture(autouse=True)
def _stores(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield
    fsspec.filesystem("memory").store.clear()


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "runs/reach/2026-01-01_00-00-00_s0"
    (folder / "policies").mkdir(parents=True)
    write_policy(folder / "policies/best.safetensors")
    (folder / "run.json").write_text(json.dumps(STATUS))
    files.write_sealed(folder / "recipe.yaml", "algo: ppo\ntotal_timesteps: 1000\nseed: 3\n")
    return folder


@pytest.fixture
def pushed(run):
    push_run(str(run), ADDRESS)
    return fsspec.filesystem("memory")


def test_push_and_use(run, pushed):
    fetched = find_run(ADDRESS)
    assert fetched.recipe().seed == 3
    policy = find_policy(ADDRESS)
    assert policy.file.read_bytes() == (run / "policies/best.safetensors").read_bytes()
    assert policy.run.path == fetched.path
    card = pushed.cat("/lab/reach/README.md").decode()
    assert "| seed | 3 |" in card
    assert "| evaluation during training | not evaluated |" in card


def test_a_downloaded_run_names_no_folder_of_this_machine(run, tmp_path):
    """A stranger's run.json must not decide which code is imported."""
    (tmp_path / "swing.py").write_text("")
    (tmp_path / "swinging_legs.py").write_text("")
    status = json.dumps(STATUS | {"folder": str(tmp_path)}).encode()
    store.push({"policies/best.safetensors": run / "policies/best.safetensors", "run.json": status}, ADDRESS)
    fetched = find_run(ADDRESS)
    assert fetched.status()["folder"] == str(tmp_path)
    before = list(sys.path)
    for task in ("swing.py:Swing", "swinging_legs:Swing"):
        assert locate_task(task, fetched) == task
    assert sys.path == before


def test_from_python(run, pushed):
    policy = rlctl.load_policy(str(run))
    observation = policy.info.env.spaces()[0].sample()
    action = policy.predict(observation)
    for address in (ADDRESS, f"{ADDRESS}/policies/best.safetensors"):
        assert (rlctl.load_policy(address).predict(observation) == action).all()
    with pytest.raises(UsageError, match="on the task 'test', which is not installed"):  # it was written for that
        rlctl.evaluate(ADDRESS, episodes=1)


def test_a_folder_is_downloaded_once(pushed):
    folder = store.fetch(ADDRESS)
    pushed.rm("/lab/reach/policies/best.safetensors")
    assert store.fetch(ADDRESS) == folder


def test_one_file_and_its_checksum(run, pushed):
    address = f"{ADDRESS}/policies/best.safetensors"
    digest = hashlib.sha256((run / "policies/best.safetensors").read_bytes()).hexdigest()
    assert PolicyFile.read_info(find_policy(f"{address}#sha256={digest}").file).algo == "ppo"
    with pytest.raises(ArtifactError, match=r"its SHA-256 is .*, not 0000"):
        find_policy(f"{address}#sha256={'0' * 64}")
    manifest = hashlib.sha256(pushed.cat("/lab/reach/rlctl.json")).hexdigest()
    assert store.fetch(f"{ADDRESS}#sha256={manifest}") == store.fetch(ADDRESS)
    with pytest.raises(ArtifactError, match=r"its SHA-256 is .*, not 0000"):
        store.fetch(f"{ADDRESS}#sha256={'0' * 64}")


def test_a_checksum_is_no_path(tmp_path, run):
    (tmp_path / "best.safetensors").write_bytes((run / "policies/best.safetensors").read_bytes())
    for checksum in ("", "0" * 63, str(tmp_path), f"../../{tmp_path}"):  # of a path, the file there would be used
        with pytest.raises(UsageError, match="#sha256= takes 64 hexadecimal digits"):
            store.fetch(f"{ADDRESS}/best.safetensors#sha256={checksum}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content[:-1], "best.safetensors: truncated: "),
        (lambda content: content + b"x", "best.safetensors: larger than "),
        (lambda content: content[:-1] + b"x", "its SHA-256 differs from rlctl.json"),
    ],
)
def test_files_that_are_not_what_was_pushed(pushed, change, message):
    file = "/lab/reach/policies/best.safetensors"
    pushed.pipe_file(file, change(pushed.cat(file)))
    with pytest.raises(ArtifactError, match=message):
        find_policy(ADDRESS)
    assert not list(store._cache().iterdir())


@pytest.mark.parametrize(
    "name", ["../evil.json", "/etc/evil.json", "a/../b.json", "a//b.json", "model.pkl", "evil.py", ""]
)
def test_names_that_are_not_downloaded(name):
    entry = {"size": 0, "sha256": "0" * 64}
    fsspec.filesystem("memory").pipe_file("/bad/rlctl.json", json.dumps({"format": 1, "files": {name: entry}}).encode())
    with pytest.raises(ArtifactError, match="that rlctl does not download"):
        store.fetch("memory://bad")


def test_addresses_without_a_run():
    with pytest.raises(ArtifactError, match=r"no rlctl\.json there"):
        find_run("memory://none")
    with pytest.raises(ArtifactError, match="nothing exists at this address"):
        find_policy("memory://none/policy.safetensors")
    fsspec.filesystem("memory").pipe_file("/odd/rlctl.json", b"[1]")
    with pytest.raises(ArtifactError, match="not a manifest of rlctl"):
        find_run("memory://odd")
    with pytest.raises(UsageError, match="nosuch://here/x: "):
        find_run("nosuch://here/x")
    with pytest.raises(UsageError, match="not an address"):
        push_run(None, "here")
    assert not store.is_address("ws://127.0.0.1:8000")


@pytest.mark.slow
def test_an_s3_server(run, monkeypatch):
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.get_host_and_port()[1]}")
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        with pytest.raises(ArtifactError, match="s3://lab/reach"):
            find_policy("s3://lab/reach")
        fsspec.filesystem("s3").mkdir("lab")
        push_run(str(run), "s3://lab/reach")
        policy = find_policy("s3://lab/reach")
        assert policy.file.read_bytes() == (run / "policies/best.safetensors").read_bytes()
        with pytest.raises(ArtifactError, match="s3://nobody/reach"):
            push_run(str(run), "s3://nobody/reach")
    finally:
        server.stop()


def test_what_a_link_leads_to_is_not_uploaded(run, tmp_path):
    (tmp_path / "secret").write_text("secret")
    link = run / "tensorboard_notes"
    link.symlink_to(tmp_path / "secret")
    with pytest.raises(ArtifactError, match="a symbolic link out of the run's folder; remove it"):
        push_run(str(run), ADDRESS)
    link.unlink()
