"""Trainings and cells on a real Ray on this machine: a head and a second node, which the tests kill."""

import concurrent.futures
import contextlib
import dataclasses
import functools
import importlib.util
import json
import os
import signal
import time
from pathlib import Path

import psutil
import pytest

from rlctl.cluster.executors import choose_cell_player, choose_executor
from rlctl.cluster.ray_trainings import connect
from rlctl.evaluation.eval_request import EvalRequest
from rlctl.evaluation.vary import measure_robustness
from rlctl.launching.seeds import train_seeds
from rlctl.launching.train import run_training
from rlctl.runs.group import read_job
from rlctl.runs.train_request import TrainRequest
from tests.cluster.conftest import LINE, wait_for
from tests.cluster.driver import STOPS, Driver, assert_it_resumes, has_ended
from tests.training.comparing import assert_same_run
from tests.training.conftest import ENVS

slow = pytest.mark.slow
pytestmark = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs ray, the extra rlctl[cluster]")
MEMORY = 80 * 2**20
NODE = {"num_cpus": 1, "node_ip_address": "127.0.0.1", "object_store_memory": MEMORY}


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A head of one core, which listens on 127.0.0.1; the driver is connected."""
    before = dict(os.environ)
    os.environ |= {
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
        "RAY_TMPDIR": "/tmp",
        "RAY_AUTH_TOKEN_PATH": str(tmp_path_factory.mktemp("r") / "token"),
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_health_check_period_ms": "1000",
        "RAY_health_check_failure_threshold": "5",
    }
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
    ray = connect(cluster.address, "reach", 1)
    yield cluster
    ray.shutdown()
    with contextlib.suppress(ValueError):
        cluster.shutdown()
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture
def node(cluster, tmp_path, monkeypatch):
    """A second node of one core; runs and cells take one core each."""
    monkeypatch.chdir(tmp_path)
    Path("cluster.yaml").write_text("cpus: 1\n")
    node = cluster.add_node(**NODE)
    yield node
    if node in cluster.worker_nodes:
        cluster.remove_node(node, allow_graceful=False)


def is_on(node, pid):
    raylet = node.all_processes["raylet"][0].process.pid
    return raylet in {process.pid for process in psutil.Process(pid).parents()}


def lose(cluster, node, pid):
    """Kill a node and wait for the end of a process."""
    cluster.remove_node(node, allow_graceful=False)
    wait_for(lambda: has_ended(pid), 10)


@pytest.mark.slow
@pytest.mark.pybullet
def test_cells_are_equal_and_a_lost_node_is_no_end(cluster, node, block_run, toy, tmp_path, capsys):
    """One test, because each process of the test run would start a cluster of its own."""
    request, vary = EvalRequest(str(block_run.path), episodes=3), ["push=0:3:3", "limit=0.1:9:2"]
    on_ray = measure_robustness(request, vary, play_cells=choose_cell_player(f"ray:{cluster.address}"))
    assert on_ray.maps == measure_robustness(request, vary).maps
    assert "6 cells, on Ray, 2 at a time: 1 of its 2 cores each" in capsys.readouterr().err
    lines, codes = train_toys_and_lose_a_node(cluster, node, toy, tmp_path / "runs")
    assert codes == [2, 2, 2]  # there is no class Toy, which is no reason to retry
    assert len(toy.read_pids()) == 4
    assert sorted(read_job(tmp_path / "runs", seed).attempts for seed in (0, 1, 2)) == [1, 1, 2]
    assert any(line.startswith("attempt 2 on ") and line.endswith(": the previous attempt was lost") for line in lines)


def train_toys_and_lose_a_node(cluster, node, toy, runs):
    """Start three children on two cores, kill a node, let the others end; return their lines and codes."""
    lines = []
    runs.mkdir()
    trainings = choose_executor(f"ray:{cluster.address}")(runs, toy.task, 3, None)
    calls = [
        functools.partial(trainings.train, TrainRequest(toy.task, settings={"seed": seed}, root=runs), lines.append)
        for seed in (0, 1, 2)
    ]
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        codes = pool.submit(trainings.run, calls, "resume")
        wait_for(lambda: len(toy.read_pids()) == 2)
        time.sleep(2.0)  # the third waits for a core
        (there,) = (pid for pid in toy.read_pids() if is_on(node, pid))
        lose(cluster, node, there)
        toy.go()
        return lines, codes.result(60)


@slow
def test_a_lost_node_costs_an_attempt_and_no_bit(cluster, node, request_of_line, tmp_path, capsys):
    request = dataclasses.replace(request_of_line, settings={**request_of_line.settings, "total_timesteps": 25_600})
    make_trainings = choose_executor(f"ray:{cluster.address}")
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        training = pool.submit(train_seeds, request, "0-1", episodes=2, make_trainings=make_trainings)

        def find_pid():
            for file in tmp_path.glob("runs/Line/*_seeds/*_s*/checkpoints/0*"):
                pid = json.loads((file.parents[1] / "run.json").read_text())["pid"]
                if is_on(node, pid):
                    return pid
            return None

        lose(cluster, node, wait_for(find_pid, 100))
        result = training.result(200)
    assert result.failed == {}
    jobs = [read_job(result.score.group.path, seed) for seed in (0, 1)]
    assert [job.state for job in jobs] == ["ended", "ended"]
    assert sorted(job.attempts for job in jobs) == [1, 2]
    for seed in (0, 1):
        local = run_training(dataclasses.replace(request, settings={**request.settings, "seed": seed}))
        assert_same_run(result.score.group.find_run(seed), local.run)
    assert "the previous attempt was lost" in capsys.readouterr().err


@slow
def test_cells_of_a_lost_node_are_played_again(cluster, node, block_run, capsys):
    request, vary = EvalRequest(str(block_run.path), episodes=20), ["mass=1:3:4", "limit=0.1:9:2"]
    play = choose_cell_player(f"ray:{cluster.address}")

    def lose_the_node(*arguments):
        cells = play(*arguments)
        yield next(cells)
        actor = wait_for(lambda: [pid for pid in find_processes("ray::CellActor") if is_on(node, pid)])[0]
        lose(cluster, node, actor)
        yield from cells

    on_ray = measure_robustness(request, vary, play_cells=lose_the_node)
    assert on_ray.maps == measure_robustness(request, vary, yes=True).maps
    assert "a node was lost; its cell is played again" in capsys.readouterr().err


def find_processes(name):
    processes = psutil.process_iter(["cmdline"])
    return [process.pid for process in processes if name in " ".join(process.info["cmdline"] or [])]


@slow
@pytest.mark.parametrize(("number", "code"), STOPS)
def test_a_driver_that_ends(cluster, node, installed_rlctl, tmp_path, number, code):
    on = f"ray:{cluster.address}"
    driver = Driver(tmp_path, "--on", on)
    run, pid = driver.wait_for_checkpoint()
    ended, printed = driver.end(number)
    assert ended == code
    wait_for(lambda: has_ended(pid), 5)
    status = json.loads((run / "run.json").read_text())["status"]
    if number == signal.SIGINT:
        assert status == "interrupted"
        assert printed.strip().endswith(
            f"resume with: rlctl train --resume {run.parent.relative_to(tmp_path)} --on {on}"
        )
    assert_it_resumes(installed_rlctl, run, on)


@slow
def test_a_driver_that_does_not_answer(cluster, node, tmp_path):
    """As seen from a node that is cut off: the messages of its attempt get no answer."""
    Path("cluster.yaml").write_text("cpus: 1\nlease_s: 3\n")
    driver = Driver(tmp_path, "--on", f"ray:{cluster.address}", steps=400_000)
    _, pid = driver.wait_for_checkpoint()
    (mailbox,) = find_processes("ray::Mailbox")
    os.kill(mailbox, signal.SIGSTOP)
    wait_for(lambda: has_ended(pid), 15)
    os.kill(mailbox, signal.SIGCONT)
    code, printed = driver.end()
    assert code == 75
    assert "1 of 1 seeds failed: seed 3 with exit code 75" in printed


@slow
def test_a_run_is_given_up_after_its_retries(cluster, node, toy, tmp_path):
    Path("cluster.yaml").write_text("cpus: 1\nretries: 0\n")
    lines, codes = train_toys_and_lose_a_node(cluster, node, toy, tmp_path / "runs")
    assert sorted(codes) == [2, 2, 75]
    assert any(line.startswith("error: lost on Ray after 0 retries: ") for line in lines)


@slow
def test_no_machine_has_enough_cores(cluster, node, tmp_path):
    Path("cluster.yaml").write_text("cpus: 64\n")
    driver = Driver(tmp_path, "--on", f"ray:{cluster.address}")
    wait_for(lambda: list(tmp_path.glob("runs/*/*_seeds/.jobs/3.json")))
    code, printed = driver.end(signal.SIGINT)
    assert code == 130
    assert "1 seed, on Ray: waiting, because no machine has 64 cores (cpus in cluster.yaml)" in printed


@slow
def test_nodes_get_a_copy_of_the_task(cluster, node, rlctl, tmp_path):
    source = "import sys; print('imported', __file__, file=sys.stderr)\n"
    (tmp_path / "line.py").write_text(source + ENVS.read_text())
    driver = Driver(tmp_path, "--on", f"ray:{cluster.address}", task="line.py:Line", steps=128)
    code, printed = driver.end()
    assert code == 0, printed
    (remote,) = {line.split()[-1] for line in printed.splitlines() if line.startswith("seed 3: imported")}
    assert "/_ray_pkg_" in remote
    (run,) = tmp_path.glob("runs/*/*_seeds/*_s3")
    status = json.loads((run / "run.json").read_text())
    assert (status["task"], status["folder"]) == ("line.py:Line", str(tmp_path))
    assert rlctl("eval", run, "--episodes", 1, cwd=tmp_path.parent).returncode == 0


@slow
def test_a_cluster_that_is_gone(cluster, tmp_path):
    """The last test of this cluster. Ray ends a process that stays connected to a lost cluster, after a minute."""
    import ray

    ray.shutdown()
    (tmp_path / "cluster.yaml").write_text("cpus: 1\nlease_s: 3\n")
    driver = Driver(tmp_path, "--on", f"ray:{cluster.address}", "--set", "eval.every_steps=640", steps=400_000)
    run, pid = driver.wait_for_checkpoint()
    for kind in ("gcs_server", "raylet"):
        cluster.head_node.all_processes[kind][0].process.kill()
    code, printed = driver.end()
    assert code == 3
    group = run.parent.relative_to(tmp_path)
    assert f"error: --on ray: the cluster has not answered for 30 s; resume with --resume {group}" in printed
    wait_for(lambda: has_ended(pid), 30)


@pytest.mark.slow
def test_a_cluster_that_is_not_there(rlctl):
    """In a process of its own: one that is connected to another cluster keeps its connection."""
    done = rlctl("train", LINE, "--seeds", "0-1", "--on", "ray:127.0.0.1:1", "--no-check")
    assert done.returncode == 3
    assert "error: --on ray:127.0.0.1:1: cannot be reached: " in done.stderr
    assert "refused" in done.stderr


@slow
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


@slow
def test_a_tuning_on_ray(installed_rlctl, tmp_path):
    options = ["--set", "n_envs=2", "--set", "algo_kwargs.n_steps=32", "--set", "algo_kwargs.batch_size=32"]
    search = ["--search", "algo_kwargs.learning_rate=1e-4:1e-2", "--trials", "3"]
    done = installed_rlctl("tune", LINE, *search, "--on", "ray", "-n", "3200", *options, timeout=240)
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.glob("runs/Line/*_tune/best.yaml"))
