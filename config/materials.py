"""The library of feels: what `material = "rubber"` and `fingertip = "human-index"` stand for, and where it is from.

`materials.toml` and `fingertips.toml` hold tables as a scene would write them, with what was measured beside them. A
scene names one and may change single keys:

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

HERE: Final = Path(__file__).resolve().parent


class Measured(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A published value: a coefficient of friction, or a range of a modulus or of an exponent of the patch.

    friction, sd, low  mean, standard deviation, and the least that was seen
    load_n             N, from and to, where the source says it
    of, paper          what was measured, and in which of the papers
    """

    of: str
    paper: str
    friction: float | None = None
    sd: float | None = None
    low: float | None = None
    youngs_modulus_pa: tuple[float, float] | None = None
    patch_exponent: tuple[float, float] | None = None
    load_n: tuple[float, float] | None = None


class Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A material or a fingertip.

    about        what it is, a sentence
    holds        range within which the values mean something
    papers       where they are from
    values       what a scene gets
    measured     what is drawn beside them
    friction_of  between what the friction of a material was measured
    """

    about: str
    holds: str
    papers: tuple[str, ...]
    values: dict[str, Any]
    measured: tuple[Measured, ...] = ()
    friction_of: str = ""


class Paper(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A source, and how far it was read."""

    text: str
    read: str
    doi: str = ""


class Library(NamedTuple):
    """Named tables that stand in place of a table of a scene.

    key      which names one
    entries  the tables by name; the values of the named one stand wherever the scene says nothing itself
    instead  keys of a scene (first) beside which one of the library's does not stand
    marked   whether a filled table says that it is whole, by the key `resolved`
    """

    key: str
    entries: Callable[[], Mapping[str, Entry]]
    instead: Mapping[str, str] = MappingProxyType({})
    marked: bool = True

    def filled(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """What a scene gives of a table that names an entry, with that entry's values."""
        dropped = {theirs for ours, theirs in self.instead.items() if given.get(ours) is not None}
        values = self.entries()[given[self.key]].values
        base = {key: value for key, value in values.items() if key not in dropped}
        return _over(base, given) | ({"resolved": True} if self.marked else {})


@lru_cache(maxsize=1)
def materials() -> Mapping[str, Entry]:
    """Every material by its name; read once, when a scene first names one."""
    return _entries("materials.toml")


@lru_cache(maxsize=1)
def fingertips() -> Mapping[str, Entry]:
    """Every fingertip by its name."""
    return _entries("fingertips.toml")


@lru_cache(maxsize=1)
def papers() -> Mapping[str, Paper]:
    """Every source by its name."""
    return MappingProxyType(msgspec.convert(_tables("papers.toml"), dict[str, Paper]))


MATERIALS: Final = Library("name", materials)
FINGERTIPS: Final = Library("pad", fingertips, MappingProxyType({"radii_m": "radius_m"}))


def flat(table: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """The values of a table and of those in it, by dotted key."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{before}{key}.")
        else:
            yield before + key, value


def _entries(file: str) -> Mapping[str, Entry]:
    return MappingProxyType(msgspec.convert(_tables(file), dict[str, Entry]))


def _tables(file: str) -> dict[str, Any]:
    return tomllib.loads((HERE / file).read_text(encoding="utf-8"))


def _over(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with `changes` put in, table by table."""
    result = dict(base)
    for key, value in changes.items():
        below = base.get(key)
        both = isinstance(below, Mapping) and isinstance(value, Mapping)
        result[key] = _over(below, value) if both else value  # type: ignore[arg-type]
    return result
