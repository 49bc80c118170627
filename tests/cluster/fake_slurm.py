"""A SLURM of one machine for tests: `sbatch`, `srun`, `squeue`, `scontrol requeue` and `scancel` as small programs.

Jobs are processes; their state is a file per job in `$FAKE_SLURM`. `main` is what each of the programs calls.
"""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

COMMANDS = ("sbatch", "srun", "squeue", "scontrol", "scancel")


def install(folder: Path) -> None:
    """Write the programs into `folder/bin`."""
    (folder / "bin").mkdir(parents=True)
    for name in COMMANDS:
        program = folder / "bin" / name
        program.write_text(
            f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(Path(__file__).parent)!r})\n"
            "import fake_slurm\nfake_slurm.main(sys.argv)\n"
        )
        program.chmod(0o755)


def main(arguments):
    """Do what the program of a name does."""
    name, folder = Path(arguments[0]).name, Path(os.environ["FAKE_SLURM"])
    sys.exit(globals()[f"_{name}"](folder, arguments[1:]))


def _sbatch(folder, arguments):
    if "--refuse" in arguments:
        print("sbatch: error: Batch job submission failed: no such partition", file=sys.stderr)
        return 1
    script = Path(arguments[-1])
    number = len(list(folder.glob("*.submitted"))) + 1
    (folder / f"{number}.submitted").write_text("\n".join([os.getcwd(), *arguments]))
    first, last = map(int, re.search(r"--array=(\d+)-(\d+)", script.read_text()).groups())
    for index in range(first, last + 1):
        (folder / f"{number}_{index}.job").write_text("PD")
        _begin(folder, script, number, index)
    print(number)
    return 0


def _begin(folder, script, number, index):
    """Run a job in the background, again as often as it is requeued."""
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import fake_slurm; "
        f"fake_slurm.run_job({str(folder)!r}, {str(script)!r}, {number}, {index})"
    )
    subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def run_job(folder, script, number, index):
    """Run the script of a job until it ends without a requeue."""
    job = Path(folder) / f"{number}_{index}.job"
    output = re.search(r"--output=(\S+)", Path(script).read_text()).group(1).replace("%a", str(index))
    env = {**os.environ, "SLURM_ARRAY_JOB_ID": str(number), "SLURM_ARRAY_TASK_ID": str(index)}
    while job.exists():
        with open(output, "ab") as file:
            process = subprocess.Popen(["bash", script], env=env, stdout=file, stderr=file, start_new_session=True)
        job.write_text(f"R {process.pid}")
        process.wait()
        if not job.exists() or job.read_text() != "requeued":
            job.unlink(missing_ok=True)


def _srun(folder, arguments):
    os.execvp(arguments[1], arguments[1:])


def _squeue(folder, arguments):
    print("\n".join(file.stem for file in folder.glob("*.job")))


def _scontrol(folder, arguments):
    """Requeue: the job's processes end, and it runs again."""
    job = folder / f"{arguments[1]}.job"
    pid = int(job.read_text().split()[1])
    job.write_text("requeued")
    os.killpg(pid, signal.SIGKILL)


def _scancel(folder, arguments):
    job = folder / f"{arguments[-1]}.job"
    if job.exists() and job.read_text() == "PD":
        job.unlink()


def preempt(folder: Path, name: str, number: int = signal.SIGTERM) -> None:
    """Send a signal to every process of a running job, as SLURM does."""
    deadline = time.monotonic() + 60
    while not (text := (folder / f"{name}.job").read_text()).startswith("R ") and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(int(text.split()[1]), number)
