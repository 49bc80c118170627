"""The crash harness: `rlctl train` is killed, its disk fails, its files are damaged, and nothing may be lost by it.

What is promised, for every checkpoint that was announced as saved, after any kill, full disk or restart:

(a) a resume loads it, or a newer one;
(b) the resumed run ends bit-equal to one that was never interrupted;
(c) no row of the tables is there twice, and none is missing;
(d) the best policy is never replaced by a worse one;
(e) no process and no lock is left behind.

Faults are put where SQLite's tests put them: at the Nth operation on the disk, for every N until a run passes without
one. `faulty_os.py` is the disk, `trials.py` runs trainings in forked processes, cheap enough to be killed a thousand
times, `contract.py` judges what is left. A part of each kind runs with all other tests;
`make test-crash` runs everything.
"""
