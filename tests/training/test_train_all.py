"""The tables that `make train-all` writes: from the scores of runs, between the marks of a README."""

import json

import pytest

from tests.benchmarks.train_all import (
    BEGIN,
    END,
    find_finished,
    find_group,
    format_row,
    format_table,
    list_tasks,
    read_rows,
    write_table,
)


def seed(number, success, returns, **more):
    score = {"success": success, "mean_return": returns, "action_change": 0.2, "ended_early": 0.01, "episodes": 100}
    return {"seed": number, "algo": "ppo", "steps": 1000, "seconds": 120.0, "problem": "", "score": score, **more}


def test_a_row_by_hand():
    scores = {"task": "walk", "seeds": [seed(1, 0.9, 10.0), seed(2, 1.0, 14.0), seed(3, 0.95, 12.0)]}
    # Success 90, 100, 95: mean 95, standard deviation 5. Return 10, 14, 12: mean 12, standard deviation 2.
    scores["seeds"][2]["steps"] = 2000
    assert format_row(scores) == (
        "| `walk` | ppo | 1, 2, 3 | 1,000, 1,000, 2,000 | 2.0 | 90, 100, 95 % (mean 95 ± 5) | 10, 14, 12 (mean 12 ± 2) "
        "| 0.20 | 1 % |\n"
    )


@pytest.mark.parametrize(
    ("seeds", "row"),
    [
        ([seed(1, None, 10.0)], "| `walk` | ppo | 1 | 1,000 | 2.0 |  | 10 | 0.20 | 1 % |\n"),
        ([seed(1, 1.0, 1.0, score=None, problem="damaged")], "| `walk` | | | | | damaged | | | |\n"),
    ],
)
def test_rows_of_less(seeds, row):
    assert format_row({"task": "walk", "seeds": seeds}) == row


def test_the_table_takes_its_place(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text("# Walking\n\nText.\n")
    table = format_table([{"task": "walk", "seeds": [seed(1, 0.9, 10.0), seed(2, 1.0, 14.0)]}])
    assert "| `walk` | ppo | 1, 2 |" in table
    write_table(readme, "old\n")
    write_table(readme, table)
    text = readme.read_text()
    assert text == f"# Walking\n\nText.\n\n## Scores\n\n{BEGIN}\n{table}\n{END}"
    # Another task's runs are elsewhere now: its row stays.
    write_table(readme, format_table([{"task": "run", "seeds": [seed(3, 0.5, 4.0)]}], read_rows(readme)))
    rows = read_rows(readme)
    assert list(rows) == ["run", "walk"]
    assert rows["walk"] in table
    assert rows["run"].startswith("| `run` | ppo | 3 |")


def test_nothing_is_trained_yet(tmp_path):
    assert {"reach", "ant"} <= set(list_tasks())
    assert find_group("reach", [1], tmp_path) is None
    assert find_finished("reach", tmp_path) is None


def test_runs_outside_of_groups_are_found(tmp_path):
    for seed, status in ((1, "finished"), (2, "interrupted"), (4, "finished")):
        folder = tmp_path / "reach" / f"2026-01-01_00-00-00_s{seed}"
        folder.mkdir(parents=True)
        (folder / "run.json").write_text(json.dumps({"task": "reach", "status": status}))
    group = find_finished("reach", tmp_path)
    assert group is not None
    assert group.seeds == [1, 4]
    assert find_group("reach", [1, 4], tmp_path) == group
    assert find_group("reach", [1, 2], tmp_path) is None
