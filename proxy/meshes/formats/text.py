"""Numbers in text files, without a Python object for each."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.meshes.formats.polygons import Indices


def clean(data: bytes) -> bytes:
    """Return the text of a file with line feeds at the end of lines, without a byte order mark.

    Raises ValueError for UTF-16, which some editors write.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise ValueError("is text in UTF-16: save it as UTF-8")
    text = data.removeprefix(b"\xef\xbb\xbf")
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in text else text


def parse_numbers(text: bytes, dtype: Any) -> NDArray[Any]:
    """Return the numbers of a text, separated by white space. Raises ValueError for other text."""
    if not text.strip():
        return np.empty(0, dtype)
    if b"," in text:
        raise ValueError("has decimal commas: write its numbers with points")
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
    word[1:] &= codes[:-1] <= 32  # only the first byte of each word
    ends = np.append(np.flatnonzero(codes == 10), len(codes))
    return np.diff(np.searchsorted(np.flatnonzero(word), ends), prepend=0)


def _is_number(word: bytes, dtype: Any) -> bool:
    try:
        np.dtype(dtype).type(word)
    except (ValueError, OverflowError):
        return False
    return True
