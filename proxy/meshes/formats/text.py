"""Numbers in text files, without a Python object for each.

A call of `re` or `numpy.fromstring` holds the interpreter lock until it returns. While a daemon loads a scene, threads
of drivers need the lock to pass forces to their devices, so a text is read in blocks that take milliseconds.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.meshes.formats.polygons import Indices

BLOCK_BYTES: Final = 1 << 16
_LINE_END: Final = re.compile(rb"\n")
_WORD_END: Final = re.compile(rb"\s")


def clean(data: bytes) -> bytes:
    """Return the text of a file with line feeds at the end of lines, without a byte order mark.

    Raises ValueError for UTF-16, which some editors write.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise ValueError("is text in UTF-16: save it as UTF-8")
    text = data.removeprefix(b"\xef\xbb\xbf")
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text


def iter_blocks(text: bytes, end: re.Pattern[bytes] = _LINE_END) -> Iterator[tuple[int, int]]:
    """Yield the ranges of blocks of about BLOCK_BYTES bytes, each up to the end of a match of `end`."""
    start = 0
    while start < len(text):
        match = end.search(text, start + BLOCK_BYTES)
        stop = match.end() if match else len(text)
        yield start, stop
        start = stop


def find_in_lines(pattern: re.Pattern[bytes], text: bytes) -> bytes:
    """Return the groups of a pattern with one group, which matches within a line; one per line."""
    found = (pattern.findall(text, *block) for block in iter_blocks(text))
    return b"\n".join(b"\n".join(matches) for matches in found if matches)


def remove_in_lines(pattern: bytes, text: bytes) -> bytes:
    """Return the text without the matches of a pattern, each within a line."""
    return b"".join(re.sub(pattern, b"", text[start:stop]) for start, stop in iter_blocks(text))


def parse_numbers(text: bytes, dtype: Any) -> NDArray[Any]:
    """Return the numbers of a text, separated by white space. Raises ValueError for other words."""
    if b"," in text:
        raise ValueError("has decimal commas: write its numbers with points")
    blocks = (_parse_block(text[start:stop], dtype) for start, stop in iter_blocks(text, _WORD_END))
    return np.concatenate([np.empty(0, dtype), *blocks])


def _parse_block(text: bytes, dtype: Any) -> NDArray[Any]:
    if not text.strip():
        return np.empty(0, dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.fromstring(text, dtype, sep=" ")
        except (DeprecationWarning, ValueError) as error:
            bad = next((word for word in text.split() if not _is_number(word, dtype)), b"")
            raise ValueError(f"is damaged: {bad[:40].decode('latin-1')!r} is not a number") from error


def count_words_per_line(text: bytes) -> Indices:
    """Return the number of words of each line."""
    codes = np.frombuffer(text, np.uint8)
    word = codes > 32
    word[1:] &= codes[:-1] <= 32  # keeps the first byte of each word
    ends = np.append(np.flatnonzero(codes == 10), len(codes))
    return np.diff(np.searchsorted(np.flatnonzero(word), ends), prepend=0)


def _is_number(word: bytes, dtype: Any) -> bool:
    try:
        np.dtype(dtype).type(word)
    except (ValueError, OverflowError):
        return False
    return True
