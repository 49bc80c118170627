"""Trainings on a real Ray: a head without cores and two nodes of this machine, of which one is lost."""

import concurrent.futures
import contextlib
import dataclasses
import importlib.util
import os
import threading
import time

import psutil
import pytest

from rlctl.cluster.executors import choose_executor
from rlctl.cluster.ray_connection import connect
from rlctl.errors import TaskError
from rlctl.run.job import read_job
from rlctl.training.request import run_training
from rlctl.training.seeds import train_seeds
from tests.cluster.conftest import LINE
from tests.training.comparing import assert_same_run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs ray, the extra rlctl[cluster]"),
]
MEMORY = 80 * 2**20


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A head and two nodes of one core, which listen on 127.0.0.1."""
    folder = tmp_path_factory.mktemp("r")
    os.environ.update(
        {
            "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
            "RAY_TMPDIR": "/tmp",
            "RAY_AUTH_TOKEN_PATH": str(folder / "token"),
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_health_check_period_ms": "1000",
            "RAY_health_check_failure_threshold": "5",
        }
    )
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 0, "include_dashboard": False, "node_ip_address": "127.0.0.1", "object_store_memory": MEMORY}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    for _ in range(2):
        cluster.add_node(num_cpus=1, node_ip_address="127.0.0.1", object_store_memory=MEMORY)
    ray = connect(cluster.address)
    yield cluster
    ray.shutdown()
    with contextlib.suppress(ValueError):
        cluster.shutdown()


def test_a_lost_node_costs_an_attempt_and_no_bit(cluster, request_of_line, tmp_path, capsys):
    (tmp_path / "cluster.yaml").write_text("cpus: 1\n")
    request = dataclasses.replace(request_of_line, settings={**request_of_line.settings, "total_timesteps": 25_600})
    done = []
    make_trainings = choose_executor(f"ray:{cluster.address}")
    thread = threading.Thread(
        target=lambda: done.append(train_seeds(request, "0-1", episodes=2, make_trainings=make_trainings))
    )
    thread.start()
    deadline = time.monotonic() + 100
    while not (checkpoints := list(tmp_path.glob("runs/Line/*_seeds/*_s*/checkpoints/0*"))):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    folder = checkpoints[0].parents[2]
    pid = int((checkpoints[0].parents[1] / "run.json").read_text().partition('"pid": ')[2].partition(",")[0])
    ancestors = {process.pid for process in psutil.Process(pid).parents()}
    node = next(node for node in cluster.worker_nodes if _raylet(node) in ancestors)
    cluster.remove_node(node, allow_graceful=False)
    gone = time.monotonic()
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < gone + 10
        time.sleep(0.05)
    thread.join(200)
    (result,) = done
    assert result.failed == {}
    jobs = [read_job(folder, seed) for seed in (0, 1)]
    assert {job.state for job in jobs} == {"ended"}
    assert max(job.attempts for job in jobs) >= 2
    for seed in (0, 1):
        local = run_training(dataclasses.replace(request, settings={**request.settings, "seed": seed}))
        assert_same_run(result.score.group.find_run(seed), local.run)
    assert "the previous attempt was lost" in capsys.readouterr().err


def _raylet(node):
    return node.all_processes["raylet"][0].process.pid


def test_a_cluster_that_is_not_there(tmp_path):
    with pytest.raises(TaskError, match="cannot be reached"):
        choose_executor("ray:127.0.0.1:1")(tmp_path, 1, None)


def test_a_ray_of_its_own_trains_and_listens_on_loopback_alone(installed_rlctl, tmp_path):
    """In processes of their own: Ray's environment variables would stay in this one."""
    options = ["--set", "n_envs=2", "--set", "algo_kwargs.n_steps=32", "--set", "algo_kwargs.batch_size=32"]
    command = ["train", LINE, "--seeds", "0-1", "--on", "ray", "--no-check", "-n", "3200", *options]
    listening = set()
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        training = pool.submit(installed_rlctl, *command, timeout=200)
        while not training.done():
            listening |= {
                connection.laddr.ip
                for process in psutil.process_iter(["name"])
                if process.info["name"] in ("raylet", "gcs_server")
                for connection in _connections(process)
                if connection.status == psutil.CONN_LISTEN
            }
            time.sleep(0.2)
    assert training.result().returncode == 0, training.result().stderr
    assert listening <= {"127.0.0.1", "::ffff:127.0.0.1"}
    assert listening
    assert len(list(tmp_path.glob("runs/Line/*_seeds/*_s*/policies/best.safetensors"))) == 2


def _connections(process):
    try:
        return process.net_connections()
    except psutil.Error:  # it has ended
        return []


def test_a_tuning_on_ray(installed_rlctl, tmp_path):
    options = ["--set", "n_envs=2", "--set", "algo_kwargs.n_steps=32", "--set", "algo_kwargs.batch_size=32"]
    search = ["--search", "algo_kwargs.learning_rate=1e-4:1e-2", "--trials", "3"]
    done = installed_rlctl("tune", LINE, *search, "--on", "ray", "-n", "3200", *options, timeout=240)
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.glob("runs/Line/*_tune/best.yaml"))
