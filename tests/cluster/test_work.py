"""What a node checks before it trains."""

import dataclasses

import pytest

from rlctl.cluster.work import ClusterSettings, execute, make_work, mark_shared_folder


@pytest.fixture
def work(request_of_line, tmp_path):
    """The work of a task that prints where it is and does not train."""
    toy = tmp_path / "toy.py"
    toy.write_text("print('imported')\nimport missing_module\n")
    folder = tmp_path / "runs"
    folder.mkdir()
    request = dataclasses.replace(request_of_line, task="toy.py:Toy", settings={"seed": 3})
    return make_work(request, mark_shared_folder(folder), ClusterSettings())


def run(work):
    lines = []
    return execute(work, lines.append, lambda: 0), "\n".join(lines)


def test_a_task_that_fails_is_an_error_of_the_task(work):
    code, printed = run(work)
    assert code == 3
    assert "No module named 'missing_module'" in printed
    assert "bit-equal" not in printed


def test_another_version_of_a_library_is_a_warning(work):
    code, printed = run(dataclasses.replace(work, versions={**work.versions, "numpy": "1.0"}))
    assert code == 3
    assert "warning: not bit-equal: numpy 1.0 on the driver, 2." in printed


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"versions": {"rlctl": "0.0.1"}}, "but 0.0.1 on the driver: install the same version"),
        ({"source_sha256": "0" * 64}, "the file of task 'toy.py:Toy' differs from the driver's"),
        ({"token": "another"}, "this node has a different folder there, or none; share the runs folder"),
        ({"root": "/nowhere/runs"}, "/nowhere/runs: this node has a different folder there, or none"),
        ({"cwd": "/nowhere"}, "this node has a different folder there, or none"),
    ],
)
def test_what_a_node_refuses(work, changes, message):
    versions = {**work.versions, **changes.pop("versions", {})}
    code, printed = run(dataclasses.replace(work, **{"versions": versions, **changes}))
    assert code == 5
    assert message in printed
    assert "imported" not in printed


def test_paths_of_a_work_are_absolute(work, tmp_path):
    assert work.root == str(tmp_path / "runs")
    assert work.request["root"] == work.root


def test_demonstrations_outside_of_the_copied_folder_are_found(request_of_line, tmp_path, monkeypatch):
    here, demos = tmp_path / "here", tmp_path / "demos"
    here.mkdir()
    demos.mkdir()
    monkeypatch.chdir(here)
    settings = {"seed": 3}
    for name, expected in (("../demos", str(demos)), ("D4RL/door/human-v2", "D4RL/door/human-v2")):
        request = dataclasses.replace(request_of_line, task="toy.py:Toy", demos=name, root=tmp_path, settings=settings)
        assert make_work(request, "token", ClusterSettings()).request["demos"] == expected
