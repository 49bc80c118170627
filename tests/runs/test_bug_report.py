"""`rlctl bugreport`: what a bug report needs, and nothing personal."""

import pytest

from rlctl.runs import bug_report


def test_a_run_is_described(write_run):
    write_run(
        "reach/2026-01-01_00-00-00_s0", command=["rlctl", "train", "reach"], steps=1000, versions={"torch": "1.0"}
    )
    text = bug_report.write_bug_report(None)  # the newest run
    assert text.startswith("rlctl 0.")
    for part in ("command: `rlctl train reach`", "status: finished, 1,000 steps", "recipe:\n```yaml\nalgo: ppo\n"):
        assert part in text
    assert "differ from those above: {'torch': '1.0'}" in text
    assert "metrics.csv:\n```\nsteps 500, seconds 5, return -1, success 0.1\n" in text


def test_without_a_run_it_describes_the_installation(rlctl):
    done = rlctl("bugreport")
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "no run")


def test_a_missing_run_is_an_error(rlctl):
    assert rlctl("bugreport", "nothing").returncode == 5


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("/home/maria/robots/arm.py", "/home/USER/robots/arm.py"),
        ("/Users/jo/x", "/Users/USER/x"),
        ("WANDB: s3cr3t-key-of-mine", "WANDB: ***"),
        ("push s3://me:pa55@host/x", "push s3://***@host/x"),
        ("api?key=abc123&x=1", "api?key=***&x=1"),
        ("hf_abcdefghijklmnopqrst", "***"),
        ("mail me@lab.org", "mail MAIL"),
        ("trained by ada on lovelace-7: adamant", "trained by USER on HOST: adamant"),
        ("task.key: monkey", "task.key: monkey"),
    ],
)
def test_nothing_personal_is_left(monkeypatch, text, expected):
    monkeypatch.setenv("WANDB_API_KEY", "s3cr3t-key-of-mine")
    monkeypatch.setattr(bug_report.getpass, "getuser", lambda: "ada")
    monkeypatch.setattr(bug_report.socket, "gethostname", lambda: "lovelace-7")
    assert bug_report.remove_personal(text) == expected


def test_the_home_folder_is_not_named(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", "/srv/people/grace")
    assert bug_report.remove_personal("/srv/people/grace/runs") == "~/runs"
