"""What presets and docs/mujoco.md promise of a training is what docs/mujoco-scores.csv has measured."""

import csv
import re
from pathlib import Path

import pytest

from rlctl.environments.registry import PRESETS
from rlctl.runs.train_request import TrainRequest
from rlctl.training.start import find_start

DOCS = Path(__file__).parents[2] / "docs"
TABLE_ROW = re.compile(r"\| `(\S+)-v5` \| (-?[\d,]+) \| (-?[\d,]+) to (-?[\d,]+) \| ([\d,]+) \| (\d+) \| `(\S+)` \|")
COMMENT = re.compile(r"^# About (-?[\d,]+) after ([\d,]+) steps and (two hours|\d+ minutes)", re.MULTILINE)


def read_number(text):
    return float(text.replace(",", ""))


def read_measured(environment, steps):
    """Return the scores of the best policies of each seed, and their minutes, with averaged actors if there are any."""
    with (DOCS / "mujoco-scores.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["environment"] == environment]
    kept = [row for row in rows if row["tool"].endswith(", best policy") and "last weights" not in row["tool"]]
    kept = [row for row in kept if read_number(row["budget"]) == steps]
    return [float(row["score"]) for row in kept], [float(row["minutes"]) for row in kept]


def read_rows():
    return TABLE_ROW.findall((DOCS / "mujoco.md").read_text())


def test_the_table_has_every_robot_with_a_measured_preset():
    presets = {file.stem for file in PRESETS.glob("*-v5.yaml") if COMMENT.search(file.read_text())}
    assert {f"{name.lower()}-v5" for name, *_ in read_rows()} == presets
    assert len(presets) == 7


@pytest.mark.parametrize("row", read_rows(), ids=lambda row: row[0])
def test_what_is_promised_was_measured(row):
    name, mean, lowest, highest, steps, minutes, environment = row
    scores, took = read_measured(environment, read_number(steps))
    # Another seed may come: the promise must stay within what the seeds reached.
    assert min(scores) - 1 <= read_number(mean) <= max(scores) + 1
    assert min(scores) - 1 <= read_number(lowest) <= read_number(highest) <= max(scores) + 1
    assert 0.7 * min(took) <= read_number(minutes) <= 1.4 * max(took)
    about, comment_steps, comment_time = COMMENT.search((PRESETS / f"{name.lower()}-v5.yaml").read_text()).groups()
    assert min(scores) - 10 <= read_number(about) <= max(scores) + 10
    assert comment_steps == steps
    comment_minutes = 120 if comment_time == "two hours" else read_number(comment_time.split()[0])
    assert 0.7 * min(took) <= comment_minutes <= 1.4 * max(took)


def test_a_training_by_a_preset_begins_with_what_to_expect(tmp_path):
    start = find_start(TrainRequest("Hopper-v4", root=tmp_path))
    (note,) = start.notes
    assert note.startswith("recipe presets/hopper-v5: For Hopper-v5: XQC ")
    assert "after 200,000 steps and 80 minutes, measured on Hopper-v4" in note
    other = find_start(TrainRequest("Hopper-v4", settings={"algo": "sac"}, root=tmp_path))
    assert not any("80 minutes" in line for line in other.notes)
