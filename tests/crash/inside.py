"""What a trial does in its own process before and while it trains: the plan's faults, and a log of what was done."""

import functools
import json
import os
import subprocess
import sys
from pathlib import Path

from rlctl.processes import child_process
from tests.crash import outside_changes
from tests.crash.faulty_os import FaultyOs, FaultyShutil


def run(arguments, plan):
    """Run the command line as a plan has it; return its exit code. The current folder gets a file `log`."""
    log = _opened(Path("log"))
    if plan.get("cores", 1) == 1:
        # One core, one worker: a trial is a matter of less than a second.
        os.sched_setaffinity(0, {plan["core"]})
    if plan.get("real_workers"):
        child_process.start_process = subprocess.Popen
    from rlctl.storage import files
    from rlctl.training import checkpoints

    checkpoints.CHECKPOINT_TIME_SHARE = plan.get("time_for_checkpoints", 1e9)  # at every boundary
    _announce(checkpoints.Checkpoints, log)
    files.os = FaultyOs(log, **plan.get("disk", {}))
    files.shutil = FaultyShutil(files.os)
    if "outside_change" in plan:
        outside_changes.begin(**plan["outside_change"])
    if "signal" in plan:
        from tests.crash import phases

        phases.send(**plan["signal"])
    from rlctl import cli

    sys.argv = ["rlctl", *arguments]
    code = cli.run(arguments)
    log(f"operations {files.os.count}")
    return code


def _opened(file: Path):
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC, 0o644)
    return lambda text: os.write(descriptor, f"{text}\n".encode())


def _announce(saver, log):
    """Log what is announced: each checkpoint whose saving came back as done."""
    original = saver.save

    @functools.wraps(original)
    def checkpoint(self, *arguments, **options):
        saved = original(self, *arguments, **options)
        if saved:
            log(f"saved {self.saved_step}")
        return saved

    saver.save = checkpoint


if __name__ == "__main__":
    sys.exit(run(*json.loads(sys.argv[1])))
