"""Library of materials and fingertips, such as `material = "rubber"` and `fingertip = "human-index"`, with sources.

`materials.toml` and `fingertips.toml` contain tables as in a scene, together with published measurements. A scene names
an entry and may change single keys:

    material = "rubber"
    material = { name = "rubber", stiffness_n_per_m = 800, friction = { kinetic = 0.6 } }
    fingertip = "human-index"
    fingertip = { pad = "human-index", radius_m = 0.008 }
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import msgspec

FOLDER: Final = Path(__file__).resolve().parent


class Measurement(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Published value: a coefficient of friction, or a range of a modulus or of an exponent of the patch.

    friction, sd, low  mean, standard deviation and smallest observed value
    load_n             N, from and to, if the source gives it
    of, paper          measured object, and key of the paper
    """

    of: str
    paper: str
    friction: float | None = None
    sd: float | None = None
    low: float | None = None
    youngs_modulus_pa: tuple[float, float] | None = None
    patch_exponent: tuple[float, float] | None = None
    load_n: tuple[float, float] | None = None


class LibraryEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Material or fingertip of the library.

    about        description in one sentence
    holds        range in which the values are valid
    papers       sources of the values
    values       keys and values for a scene
    measured     published values, drawn for comparison
    friction_of  pair of surfaces of the friction coefficients
    """

    about: str
    holds: str
    papers: tuple[str, ...]
    values: dict[str, Any]
    measured: tuple[Measurement, ...] = ()
    friction_of: str = ""


class Paper(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Source, and how much of it was read."""

    text: str
    read: str
    doi: str = ""


class Library(NamedTuple):
    """Named tables that replace a table of a scene.

    key      key that names an entry
    entries  function that returns all entries by name; an entry supplies the values that the scene leaves out
    instead  keys of a scene, each with the key of the entry that it replaces
    marked   mark a filled table as complete, by the key `resolved`
    """

    key: str
    entries: Callable[[], Mapping[str, LibraryEntry]]
    instead: Mapping[str, str] = MappingProxyType({})
    marked: bool = True

    def fill(self, table: Mapping[str, Any]) -> dict[str, Any]:
        """Return a table that names an entry, completed with the values of the entry."""
        dropped = {replaced for key, replaced in self.instead.items() if table.get(key) is not None}
        values = self.entries()[table[self.key]].values
        base = {key: value for key, value in values.items() if key not in dropped}
        filled = _merge(base, table)
        return dict(filled, resolved=True) if self.marked else filled


@lru_cache(maxsize=1)
def load_materials() -> Mapping[str, LibraryEntry]:
    """Return all materials by name; the file is read when a scene first names one."""
    return _load_entries("materials.toml")


@lru_cache(maxsize=1)
def load_fingertips() -> Mapping[str, LibraryEntry]:
    return _load_entries("fingertips.toml")


@lru_cache(maxsize=1)
def load_papers() -> Mapping[str, Paper]:
    """Return all sources by name."""
    return MappingProxyType(msgspec.convert(_load_tables("papers.toml"), dict[str, Paper]))


MATERIALS: Final = Library("name", load_materials)
FINGERTIPS: Final = Library("pad", load_fingertips, MappingProxyType({"radii_m": "radius_m"}))


def flatten_entry(table: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from flatten_entry(value, f"{before}{key}.")
        else:
            yield before + key, value


def _load_entries(file: str) -> Mapping[str, LibraryEntry]:
    return MappingProxyType(msgspec.convert(_load_tables(file), dict[str, LibraryEntry]))


def _load_tables(file: str) -> dict[str, Any]:
    return tomllib.loads((FOLDER / file).read_text(encoding="utf-8"))


def _merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in changes.items():
        below = base.get(key)
        are_tables = isinstance(below, Mapping) and isinstance(value, Mapping)
        result[key] = _merge(below, value) if are_tables else value  # type: ignore[arg-type]
    return result
