"""`rlctl replay TASK --policy reference` shows the clip that a task follows, from its start."""

import numpy as np
import pytest

from rlctl.errors import UsageError
from rlctl.replaying.replay import run_replay
from rlctl.replaying.replay_request import ReplayRequest
from rlctl.replaying.sources import TaskSource


def test_bodies_are_where_the_clip_has_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    request = ReplayRequest(
        "rlctl_locomotion.follow:QuadrupedBow", baseline="reference", settings=["task.episode_s=0.4"]
    )
    source = TaskSource(request, "reference")
    shown = []

    def watch(step):
        task = source._env.unwrapped.task
        now = task.reference.compare(task.body, task.rows)
        shown.append((int(task.rows[0]), float(now.joints[0]), float(now.place[0])))

    monkeypatch.setattr(source, "watch", watch)
    (episode,) = source.record()
    rows, joints, places = zip(*shown, strict=True)
    assert rows == (*range(21),)
    assert joints[1:] == pytest.approx(np.zeros(20), abs=1e-6)
    assert places[1:] == pytest.approx(np.zeros(20), abs=1e-6)
    # Nobody can play it again, so there is no episode.
    assert episode.recording.name == "QuadrupedBow-reference.rrd"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["QuadrupedBow-reference.rrd"]


def test_a_task_without_a_clip():
    with pytest.raises(UsageError, match="--policy reference: walk follows no clip; rlctl tasks new NAME --model FILE"):
        run_replay(ReplayRequest("walk", baseline="reference"))
    with pytest.raises(UsageError, match="leave out --worst"):
        run_replay(ReplayRequest("rlctl_locomotion.follow:QuadrupedBow", baseline="reference", worst=1))
