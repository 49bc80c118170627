"""`python -m rlctl`."""

import os
import sys

if __name__ == "__main__":
    if not sys.flags.safe_path and sys.path[:1] == [os.getcwd()]:
        # Python puts the current folder first, where a stranger's numpy.py would be taken for NumPy.
        sys.path.append(sys.path.pop(0))
    from rlctl.cli import main

    main()
