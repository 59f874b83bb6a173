"""Records as arrays with access by field name, according to the table of a tick."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import HapticError
from softfinger.proxy.record import FIELDS, NAMED, RECORD_SIZE, list_columns

if TYPE_CHECKING:
    import pandas

STRUCTURE: Final = np.dtype([(field.name, np.float64, (field.size,) if field.size > 1 else ()) for field in FIELDS])
"""Record as numpy's structured type, with dotted names; integers are exact in it."""


class NoField(HapticError, KeyError):
    """Name that is not a field of a record."""

    __str__ = Exception.__str__  # KeyError shows its message in quotes


class Records(np.ndarray[Any, np.dtype[np.float64]]):
    """Records (..., RECORD_SIZE) float64, one row per tick, with access to fields by telemetry name.

    `records["force"]` is (..., 3), a view; `records["contact.mode"]` is (...,): integer fields are int64 copies. Rows
    are selected as in any array, and preserve their names: `records[records["contact.mode"] == 2]["force"]`. A
    selection without complete rows is a plain array.

    Examples
    --------
    >>> from softfinger import run_recording
    >>> records = run_recording("tap")
    >>> records["force"].shape, int(records["contact.mode"].max())
    ((2281, 3), 1)
    >>> records[records["contact.penetration"].argmax()]["probe.position"].round(4).tolist()
    [0.0, 0.0, 0.009]
    """

    def __new__(cls, rows: NDArray[np.float64]) -> Self:
        """Return a view of the same memory. Raises ValueError if the rows are not records."""
        if rows.shape[-1:] != (RECORD_SIZE,):
            raise ValueError(
                f"an array of shape {rows.shape} contains no records: rows must have {RECORD_SIZE} columns"
            )
        return rows.view(cls)

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, str):
            return self._find_field(key)
        item = super().__getitem__(key)
        whole = not isinstance(item, Records) or item.shape[-1:] == (RECORD_SIZE,)
        return item if whole else item.view(np.ndarray)

    def _find_field(self, name: str) -> NDArray[Any]:
        field = NAMED.get(name)
        if field is None:
            from softfinger.config.words import suggest

            raise NoField(
                f"no field of a record is called {name!r}{suggest(name, NAMED)}: choose from {', '.join(NAMED)}"
            )
        rows = self.view(np.ndarray)
        if field.size > 1:
            return rows[..., field.at : field.at + field.size]
        return rows[..., field.at].astype(np.int64) if field.kind == "int" else rows[..., field.at]

    def __repr__(self) -> str:
        count = f"{' x '.join(map(str, self.shape[:-1]))} ticks" if self.ndim > 1 else "one tick"
        return f"<Records: {count}; fields {', '.join(NAMED)}>"

    def _repr_html_(self) -> str:
        """Return a table of the last tick, a row for each field, for notebooks."""
        from html import escape

        row = self.view(np.ndarray).reshape(-1, RECORD_SIZE)[-1:]
        cells = "".join(
            f"<tr><th>{field.name}</th><td>{', '.join(f'{x:.6g}' for x in row[0, field.at :][: field.size])}</td>"
            f"<td>{escape(field.unit)}</td><td>{escape(field.meaning)}</td></tr>"
            for field in (FIELDS if len(row) else ())
        )
        return f"<p>{escape(repr(self).partition(';')[0].strip('<'))}, the last of them:</p><table>{cells}</table>"

    def _ipython_key_completions_(self) -> list[str]:
        """Return the completions that IPython and notebooks offer after `records[`."""
        return list(NAMED)

    @property
    def structured(self) -> NDArray[Any]:
        """The same memory (...,) as numpy's structured type, with a name for each field."""
        return np.ascontiguousarray(self.view(np.ndarray)).view(STRUCTURE)[..., 0]

    def to_pandas(self) -> pandas.DataFrame:
        """Return records (n, RECORD_SIZE) as a table, with the columns of a results file: `tick`, `force[0]`, ....

        Raises
        ------
        HapticError
            If pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise HapticError("to_pandas needs pandas: pip install pandas") from None
        whole = {field.name: np.int64 for field in FIELDS if field.kind == "int"}
        return pandas.DataFrame(self.view(np.ndarray), columns=list_columns()).astype(whole)
