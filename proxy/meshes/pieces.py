"""Functions on millions of triangles: equal rows, connected pieces, and corners in blocks.

Equal rows and pieces are found by compiled functions: NumPy's arrays of all edges would take gigabytes.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.decorators import entry, jit

Rows = NDArray[Any]
Numbers = NDArray[np.int32]
Vertices = NDArray[np.float64]

BLOCK_TRIANGLES: Final = 1 << 18
"""Number of triangles in a block: its arrays have some megabytes."""
_SEED: Final = secrets.randbits(63) | 1
"""Differs between processes, so that no file can be crafted whose rows all collide in the hash table."""


class Edges(NamedTuple):
    """Edges of triangles (m, 3). Side s of 3 m connects corner s % 3 of triangle s // 3 with the next corner.

    first    (3 m,)  first side along the same edge
    forward  (3 m,)  True if the vertex index increases along a side
    counts   (3 m,)  at the first side of an edge the number of its sides, else 0
    """

    first: Numbers
    forward: NDArray[np.bool_]
    counts: Numbers


class Pieces(NamedTuple):
    """Pieces of a mesh: triangles connected over edges that exactly two of them share.

    body       (m,)  index of each triangle's piece, from 0
    turned     (m,)  True if the triangle is wound against the first triangle of its piece
    one_sided  (bodies,)  True if no winding is consistent over the piece
    """

    body: Numbers
    turned: NDArray[np.bool_]
    one_sided: NDArray[np.bool_]


def iter_corner_blocks(
    vertices: Vertices, triangles: Numbers
) -> Iterator[tuple[slice, tuple[Vertices, Vertices, Vertices]]]:
    """Yield blocks of triangles (m, 3), and the three corners (n, 3) m of the triangles of each."""
    for begin in range(0, len(triangles), BLOCK_TRIANGLES):
        block = slice(begin, begin + BLOCK_TRIANGLES)
        a, b, c = triangles[block].T
        yield block, (vertices[a], vertices[b], vertices[c])


def find_first_equal(rows: Rows) -> Numbers:
    """Return for each row (n, k) of uint64 or uint32 the index of the first equal row."""
    rows = np.ascontiguousarray(rows).view(np.int32)  # one type, compiled once
    slots = 1 << max(4, (2 * len(rows)).bit_length())
    first = np.empty(len(rows), np.int32)
    for begin in range(0, len(rows), BLOCK_TRIANGLES):
        first[begin : begin + BLOCK_TRIANGLES] = _hash_rows(rows[begin : begin + BLOCK_TRIANGLES]) & np.uint64(
            slots - 1
        )
    _find_alike(rows, np.full(slots, -1, np.int32), first)
    return first


def _hash_rows(rows: Rows) -> NDArray[np.uint64]:
    mixed = np.full(len(rows), _SEED, np.uint64)
    for column in rows.T:
        mixed = (mixed ^ column.view(np.uint32)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return mixed


def find_unique_rows(rows: Rows) -> tuple[NDArray[np.int64], Numbers]:
    """Return the index of the first of each set of equal rows (n, k), and for each row the number of its set."""
    first = find_first_equal(rows)
    is_first = first == np.arange(len(first))
    return np.flatnonzero(is_first), (np.cumsum(is_first, dtype=np.int32) - np.int32(1))[first]


def find_unique_triangles(triangles: Numbers) -> NDArray[np.int64]:
    """Return the indices of the first of the triangles (m, 3) with each set of corners."""
    return find_unique_rows(np.sort(triangles, axis=1).view(np.uint32))[0]


def list_edges(triangles: Numbers) -> Edges:
    """Return the edges of triangles (m, 3)."""
    a = triangles.ravel()
    b = np.roll(triangles, -1, axis=1).ravel()
    first = find_first_equal(np.stack([np.minimum(a, b), np.maximum(a, b)], axis=1).view(np.uint32))
    return Edges(first, a < b, np.bincount(first, minlength=len(a)).astype(np.int32))


def find_pieces(edges: Edges) -> Pieces:
    """Return the connected pieces and the winding of their triangles."""
    sides = len(edges.first)
    parent, turned = np.arange(sides // 3, dtype=np.int32), np.zeros(sides // 3, np.bool_)
    torn = np.zeros(sides // 3, np.bool_)
    _unite(edges.first, edges.forward, edges.counts, parent, turned, torn)
    roots = parent == np.arange(len(parent))
    body = (np.cumsum(roots, dtype=np.int32) - np.int32(1))[parent]
    return Pieces(body, turned, torn[roots])


@entry
def _find_alike(rows: Rows, table: Numbers, first: Numbers) -> None:
    """Replace the slot of each row in `first` by the index of the first equal row.

    table  hash table of a power of two entries, all -1, more than the rows; open addressing with linear probing
    """
    for i in range(len(rows)):
        place = first[i]
        while table[place] >= 0:
            same = True
            for k in range(rows.shape[1]):
                same = same and rows[table[place], k] == rows[i, k]
            if same:
                break
            place = (place + 1) % len(table)
        if table[place] < 0:
            table[place] = i
        first[i] = table[place]


@jit
def _find_root(parent: Numbers, turned: NDArray[np.bool_], k: int, against: bool) -> tuple[int, bool]:
    """Return the root of the piece of triangle `k`, and `against` inverted if its winding is opposite to the root's."""
    while parent[k] != k:  # path halving
        above = parent[k]
        turned[k] ^= turned[above]
        parent[k] = parent[above]
        against ^= turned[k]
        k = parent[k]
    return k, against


@entry
def _unite(
    first: Numbers,
    forward: NDArray[np.bool_],
    count: Numbers,
    parent: Numbers,
    turned: NDArray[np.bool_],
    torn: NDArray[np.bool_],
) -> None:
    """Unite pieces under the lower root and track the parity of the winding; in the end each parent is a root."""
    for side in range(len(first)):
        first_side = first[side]
        if first_side == side or count[first_side] != 2:
            continue
        a, b = side // 3, first_side // 3
        against = forward[side] == forward[first_side]
        a, against = _find_root(parent, turned, a, against)
        b, against = _find_root(parent, turned, b, against)
        if a == b:
            torn[a] |= against
        elif a < b:
            parent[b], turned[b] = a, against
        else:
            parent[a], turned[a] = b, against
    for vertex in range(len(parent)):  # a parent has a lower index, so its root is already known
        above = parent[vertex]
        if above != vertex:
            turned[vertex] ^= turned[above]
            parent[vertex] = parent[above]
