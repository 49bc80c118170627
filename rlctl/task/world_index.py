"""`WorldIndex`: which of n worlds are meant."""

import numpy as np
from numpy.typing import NDArray

WorldIndex = NDArray[np.int64]
"""The numbers of k worlds, shape (k,); row i of what belongs to them is of the world with number i of these."""
