"""Texts on materials and fingertips of the library: an entry, its sources, and changes of it in a scene."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Final

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.config.fields import find_unit
from softfinger.config.load import build, describe
from softfinger.config.materials import FINGERTIPS, MATERIALS, LibraryEntry, Measurement, flatten_entry, load_papers
from softfinger.config.schema import Fingertip, Material
from softfinger.config.schema.contact import FingertipShape
from softfinger.config.words import format_value, suggest

LIBRARIES: Final = {"material": MATERIALS, "fingertip": FINGERTIPS}
_TABLES: Final[dict[str, type[msgspec.Struct]]] = {"material": Material, "fingertip": Fingertip}


def load_entries() -> dict[str, tuple[str, LibraryEntry]]:
    """Return all entries by name, each with its kind, `material` or `fingertip`."""
    return {name: (kind, entry) for kind, library in LIBRARIES.items() for name, entry in library.entries().items()}


def find_entry(name: str) -> tuple[str, LibraryEntry]:
    """Return one of `load_entries`. Raises ConfigError if the name is unknown."""
    by_name = load_entries()
    if name not in by_name:
        raise ConfigError(
            f"no material or fingertip is called {format_value(name)}{suggest(name, by_name)}; "
            f"they are {', '.join(by_name)}"
        )
    return by_name[name]


def make_library_table(kind: str, name: str) -> Any:
    """Return the table of an entry, as built from a scene that gives only its name."""
    return build(_TABLES[kind], {LIBRARIES[kind].key: name}, name)


def make_entry_rows(table: msgspec.Struct) -> list[tuple[str, str]]:
    """Return rows for `check`: the entry that a table of a scene names, and the values that differ from it.

    Returns no rows if the table names none.
    """
    kind = "fingertip" if isinstance(table, FingertipShape) else "material"
    library, mapping = LIBRARIES[kind], describe(table)
    name = mapping.get(library.key)
    if name is None:
        return []
    if name not in library.entries():
        return [("  library", f"{name}, which is not in the library of this version; the scene gives the values")]
    library_values = dict(flatten_entry(describe(make_library_table(kind, name))))
    keys = _TABLES[kind].__struct_fields__
    scene_values = {key: value for key, value in flatten_entry(mapping) if key.partition(".")[0] in keys}
    changed = [
        f"{key} {format_value(value)}"
        for key, value in scene_values.items()
        if library_values.get(key, msgspec.UNSET) != value
    ]
    missing = sorted(
        {key.partition(".")[0] for key in library_values} - {key.partition(".")[0] for key in scene_values}
    )
    changes = [*changed, *(f"no {key}" for key in missing)]
    return [("  library", f"{name}; of the scene itself: {', '.join(changes)}" if changes else f"{name}, all of it")]


def make_value_rows(entry: LibraryEntry) -> list[tuple[str, str]]:
    """Return each value that a scene gets from an entry, with its unit."""
    return [(key, f"{value:g} {find_unit(key)}".rstrip()) for key, value in flatten_entry(entry.values)]


def format_measured(study: Measurement) -> str:
    """Format a published value: `0.38 +- 0.13: palm on aluminium (buchholz-1988)`."""
    if study.youngs_modulus_pa is not None:
        low, high = (1e-3 * value for value in study.youngs_modulus_pa)
        text = f"Young's modulus {low:g} to {high:g} kPa"
    elif study.patch_exponent is not None:
        low, high = study.patch_exponent
        text = f"exponent of the patch {low:.3g}" + (f" to {high:.3g}" if high > low else "")
    else:
        text = f"friction {study.friction:g}" + (f" +- {study.sd:g}" if study.sd is not None else "")
    if study.load_n is not None:
        low, high = study.load_n
        text += f" at {low:g}" + (f" to {high:g} N" if high > low else " N")
    return f"{text}: {study.of} ({study.paper})"


def make_paper_rows(names: Collection[str]) -> list[tuple[str, str]]:
    return [
        (name, f"{paper.text}{f', doi {paper.doi}' if paper.doi else ''} (read: {paper.read})")
        for name, paper in load_papers().items()
        if name in names
    ]


def list_cited_papers(entry: LibraryEntry) -> set[str]:
    """Return the names of the papers cited for an entry's values, measurements and range."""
    return {
        *entry.papers,
        *(study.paper for study in entry.measured),
        *(paper for paper in load_papers() if paper in entry.holds),
    }
