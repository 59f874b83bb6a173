"""`softfinger materials`: the library of materials and fingertips, or one entry with its sources, as text or figure."""

from __future__ import annotations

import argparse
import json
from typing import Any

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.config.materials import LibraryEntry
from softfinger.server.offline.feel_figure import draw
from softfinger.server.offline.library_texts import (
    find_entry,
    format_measured,
    list_cited_papers,
    load_entries,
    make_paper_rows,
    make_value_rows,
)


def run(args: argparse.Namespace) -> int:
    """Print the library or an entry, and draw it if requested; return 0.

    Raises ConfigError if the name is unknown, or if a plot is requested without a name.
    """
    if args.name is None:
        if args.plot is not None:
            raise ConfigError("--plot draws one of them: softfinger materials NAME --plot FILE")
        _list(args.json)
        return 0
    kind, entry = find_entry(args.name)
    if args.plot is not None:
        draw(args.name, args.plot)
    if args.json:
        print(json.dumps(as_json(args.name, kind, entry), indent=1))
        return 0
    print(f"{args.name}: {kind}. {entry.about}")
    rows = [("holds", entry.holds)]
    rows += [("friction of", entry.friction_of)] if entry.friction_of else []
    rows += [*make_value_rows(entry), *(("measured", format_measured(measurement)) for measurement in entry.measured)]
    rows += make_paper_rows(list_cited_papers(entry))
    width = max(len(name) for name, _ in rows)
    for name, text in rows:
        print(f"  {name:{width}}  {text}")
    return 0


def as_json(name: str, kind: str, entry: LibraryEntry) -> dict[str, Any]:
    """Return an entry as plain values, with the papers as a mapping from name to text."""
    plain = msgspec.to_builtins(entry)
    measured = [
        {key: value for key, value in measurement.items() if value is not None} for measurement in plain.pop("measured")
    ]
    return {
        "name": name,
        "kind": kind,
        **plain,
        "measured": measured,
        "papers": dict(make_paper_rows(list_cited_papers(entry))),
    }


def _list(is_json: bool) -> None:
    all_entries = load_entries()
    if is_json:
        print(json.dumps([as_json(name, *entry) for name, entry in all_entries.items()], indent=1))
        return
    width = max(map(len, all_entries))
    for name, (kind, entry) in all_entries.items():
        print(f"{name:{width}}  {kind:9}  {_shorten(entry):32}  {entry.about}")


def _shorten(entry: LibraryEntry) -> str:
    values = entry.values
    if "friction" in values:
        friction = values["friction"]
        return f"{values['stiffness_n_per_m']:g} N/m, friction {friction['static']:g} {friction['kinetic']:g}"
    patch = values["patch"]
    return f"r {1e3 * values['radius_m']:g} mm, G {1e-3 * patch['shear_modulus_pa']:g} kPa"
