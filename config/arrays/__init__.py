"""Type of arrays, and readers of arrays in untrusted files, in bounded memory: npz and npy, csv, grey pictures.

Contains no format of recordings or results; drivers and server read these with the functions here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
