"""Processes that wait to become workers: forked from a trial before it has threads, they need not import anything."""

import json
import os
import socket
import subprocess
import sys
import traceback
import types


def take_over(count):
    """Fork `count` processes, and let `rlctl.rollout.workers` start these before it starts others."""
    from rlctl.rollout import workers

    spares = []
    for _ in range(count):
        ours, theirs = socket.socketpair()
        process = os.fork()
        if process == 0:
            # Or this process would keep the others waiting when the trial is gone.
            for each in (ours, *(each for _, each in spares)):
                each.close()
            _wait_for_job(theirs)
        theirs.close()
        spares.append((process, ours))

    class Popen(subprocess.Popen):
        def _execute_child(self, args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *rest):
            if not spares:
                super()._execute_child(args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *rest)
                return
            self.pid, place = spares.pop(0)
            self._child_created = True
            prints_to = rest[6]
            job = {"code": args[2], "arguments": args[3:], "passed": pass_fds}
            with place:
                socket.send_fds(place, [b"."], [*pass_fds, prints_to])
                place.sendall(json.dumps(job).encode())
            os.close(self._devnull)

    workers.subprocess = types.SimpleNamespace(
        Popen=Popen, DEVNULL=subprocess.DEVNULL, TimeoutExpired=subprocess.TimeoutExpired
    )


def _wait_for_job(place):
    """Be a worker as soon as one is wanted, and end when it ends; does not return."""
    _, received, _, _ = socket.recv_fds(place, 1, 8)
    if not received:
        os._exit(0)
    content = b"".join(iter(lambda: place.recv(2**16), b""))
    job = json.loads(content)
    code = 0
    *passed, prints_to = received
    os.setpgid(0, 0)
    os.dup2(prints_to, 1)
    os.dup2(prints_to, 2)
    os.close(prints_to)
    numbers = {str(before): str(now) for before, now in zip(job["passed"], passed, strict=True)}
    sys.argv = ["-c", *(numbers.get(each, each) for each in job["arguments"])]
    try:
        exec(job["code"], {"__name__": "__main__"})
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
