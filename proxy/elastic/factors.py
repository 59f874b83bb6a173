"""Cholesky factorisation of a stiffness matrix, for thousands of right-hand sides that touch few unknowns each.

The unknowns are ordered by nested dissection of their positions (George, 1973), and eliminated in dense fronts (Duff
and Reid, 1983). LAPACK does the arithmetic. The fronts are stored in a temporary file, so that memory is needed for one
front per thread; the page cache of the system makes reading cheap. A body of 1000 nodes takes 31 s and 0.7 GB, with
SciPy's SuperLU 61 s and 2.2 GB: it does not use the symmetry. Of CHOLMOD there is no wheel, and that of Pardiso needs
MKL.
"""

from __future__ import annotations

import os
import tempfile
import weakref
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Whole = NDArray[np.int64]

LEAF_SIZE: Final = 192
"""Number of unknowns that are not divided further."""
STRIP_COLUMNS: Final = 256
"""Columns of a front that are changed together: copies of a whole front would be the peak of memory."""


class Front(NamedTuple):
    """Columns of the factor L that are eliminated together.

    own     (k,)  unknowns of these columns
    beyond  (m,)  unknowns of later fronts in these columns
    offset        in the file, bytes: (k, k) rows `own`, lower triangle, and (k, m) rows `beyond`, transposed
    """

    own: Whole
    beyond: Whole
    offset: int


class Factors:
    """Factors of a symmetric positive definite matrix.

    Parameters
    ----------
    matrix
        Sparse (n, n) by rows (CSR), with both triangles.
    places
        (n, 3) m, positions of the unknowns.

    Raises
    ------
    ValueError
        If the matrix is not positive definite.
    OSError
        If the temporary file cannot be written.
    """

    def __init__(self, matrix: Any, places: Doubles) -> None:
        self._matrix, self._places = matrix, places
        self._fronts: Final[list[Front]] = []
        self._is_high = np.zeros(len(places), bool)
        self._position = np.full(len(places), -1)
        self.number: Final = np.full(len(places), -1)
        """Number of the front that eliminates each unknown, in the order of elimination."""
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._eliminate(np.arange(len(places)))
        self._file.flush()
        del self._matrix, self._places

    def solve(self, loads: Doubles) -> None:
        """Replace the right-hand sides (n, k) by the solutions."""
        from scipy.linalg import solve_triangular

        for front in self._fronts:
            top = loads[front.own]
            if top.any():  # a load on one patch reaches a small part of the fronts
                square, below = self._read(front)
                loads[front.own] = top = solve_triangular(square, top, lower=True, check_finite=False)
                loads[front.beyond] -= below.T @ top
        for front in reversed(self._fronts):
            square, below = self._read(front)
            top = loads[front.own] - below @ loads[front.beyond]
            loads[front.own] = solve_triangular(square, top, lower=True, trans=1, check_finite=False)

    def _write(self, own: Whole, beyond: Whole, square: Doubles, below: Doubles) -> None:
        """Append a front, in column-major order as LAPACK has it."""
        self._fronts.append(Front(own, beyond, self._file.tell()))
        for block in (square, below):
            self._file.write(np.ascontiguousarray(block.T).data)

    def _read(self, front: Front) -> tuple[Doubles, Doubles]:
        """Return `square` and `below` of a front."""
        count, columns = len(front.own), len(front.own) + len(front.beyond)
        front_rows = np.empty((columns, count))
        if os.preadv(self._file.fileno(), [front_rows.data], front.offset) != front_rows.nbytes:
            raise OSError("a temporary file is truncated")
        return front_rows[:count].T, front_rows[count:].T

    def _eliminate(self, part: Whole) -> tuple[Whole, Doubles]:
        """Eliminate the unknowns of a part; return the unknowns that these act on, and the change of their matrix."""
        from scipy.linalg import LinAlgError, cholesky, solve_triangular

        parts, own = self._divide(part)
        children = [self._eliminate(half) for half in parts]
        rows = self._matrix[own].tocoo()
        self.number[own] = len(self._fronts)
        later = np.unique(np.concatenate([rows.col, *(of_child for of_child, _ in children)]))
        beyond = later[self.number[later] < 0]
        count, unknowns = len(own), np.concatenate([own, beyond])
        self._position[unknowns] = np.arange(len(unknowns))
        matrix = np.zeros((len(unknowns), len(unknowns)), order="F")
        at = self._position[rows.col]
        matrix[at[at >= 0], rows.row[at >= 0]] = rows.data[at >= 0]
        while children:
            of_child, change = children.pop()
            at = self._position[of_child]
            for columns in _iter_strips(len(at)):
                matrix[np.ix_(at, at[columns])] += change[:, columns]
            del change
        self._position[unknowns] = -1
        try:
            square = cholesky(matrix[:count, :count], lower=True, check_finite=False)
        except LinAlgError as error:
            raise ValueError("fixed: the body can still move: choose a larger region in each of its parts") from error
        below = solve_triangular(square, matrix[count:, :count].T, lower=True, check_finite=False)
        self._write(own, beyond, square, below)
        rest = matrix[count:, count:].copy(order="F")
        del matrix
        for columns in _iter_strips(len(beyond)):
            rest[:, columns] -= below.T @ below[:, columns]
        return beyond, rest

    def _divide(self, part: Whole) -> tuple[list[Whole], Whole]:
        """Return two parts without a common entry of the matrix, and the unknowns that separate them."""
        if len(part) <= LEAF_SIZE:
            return [], part
        places = self._places[part]
        ordered = part[places[:, np.ptp(places, axis=0).argmax()].argsort(kind="stable")]
        low, high = np.array_split(ordered, 2)
        self._is_high[high] = True
        rows = self._matrix[low]
        separates = np.logical_or.reduceat(self._is_high[rows.indices], rows.indptr[:-1])  # no row is empty
        self._is_high[high] = False
        separates[0] |= not separates.any()  # a front is not empty
        return [half for half in (low[~separates], high) if len(half)], low[separates]


def _iter_strips(count: int) -> list[slice]:
    """Return the columns of a front with `count` columns, in strips."""
    return [slice(first, first + STRIP_COLUMNS) for first in range(0, count, STRIP_COLUMNS)]
