"""What the children of test_child_process.py do; without pytest, which each would import."""

import os
import struct
import subprocess
import sys

from rlctl.processes import messages


def answer(connection, **arguments):
    """Print, send what was given, and wait."""
    print("out")
    print("err", file=sys.stderr, flush=True)
    given = {**arguments, "threads": os.environ["OMP_NUM_THREADS"], "hash": os.environ.get("PYTHONHASHSEED", "")}
    messages.send(connection, given)
    if arguments.get("exits"):
        os._exit(arguments["exits"])
    if arguments.get("starts"):
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], **arguments["starts"])
        messages.send(connection, child.pid)
    if arguments.get("prints"):
        os.write(connection.fileno(), struct.pack("!i", 5) + b"hello")
    messages.receive(connection)
