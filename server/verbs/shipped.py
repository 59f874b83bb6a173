"""`softfinger scenes`, `rigs`, `recordings`, `faults`, `experiments`: list the shipped files with one line each."""

from __future__ import annotations

import argparse
import json
import re
import tomllib
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

from softfinger.config.schema import Faults, Rig, Scene
from softfinger.config.sources import EXPERIMENTS, FOLDERS
from softfinger.drivers.poses import SHIPPED
from softfinger.server.offline.library_texts import load_entries

FOLDER_OF: Final = {
    "scenes": FOLDERS[Scene],
    "rigs": FOLDERS[Rig],
    "recordings": SHIPPED,
    "faults": FOLDERS[Faults],
    "experiments": EXPERIMENTS,
}

OPTIONS: Final = {
    "--scene": "scenes",
    "--rig": "rigs",
    "--recording": "recordings",
    "--poses": "recordings",
    "--inject": "faults",
}
"""Verb that lists the shipped names for each option that takes a name or a file."""
POSITIONALS: Final = {
    ("experiment", "file"): "experiments",
    ("materials", "name"): "materials",
    ("warmup", "scenes"): "scenes",
} | {(verb, "recording"): "recordings" for verb in ("info", "export", "replay", "view", "bridge")}
"""The same for positional arguments, by verb and argument."""

_SENTENCE: Final = re.compile(r"(?s)(.*?\.)(?=\s|$)")


def run(args: argparse.Namespace) -> int:
    items = describe_shipped(args.verb)
    if args.json:
        print(json.dumps(items, indent=1))
        return 0
    width = max(len(item["name"]) for item in items)
    for shipped_file in items:
        print(f"{shipped_file['name']:{width}}  {shipped_file['description']}")
    return 0


def describe_shipped(verb: str) -> list[dict[str, Any]]:
    """Return name, file and description of each shipped file, ordered by name."""
    folder = FOLDER_OF[verb]
    if verb == "recordings":
        files = sorted(folder.glob("*.csv"))
        motions = tomllib.loads((folder / "motions.toml").read_text("utf-8"))
        descriptions = {file.name: f"{_measure_duration(file):.1f} s: {motions[file.stem]['motion']}" for file in files}
    else:
        files = sorted(folder.glob("*.toml"))
        descriptions = {file.name: extract_first_sentence(file.read_text("utf-8")) for file in files}
    return [{"name": file.stem, "file": str(file), "description": descriptions[file.name]} for file in files]


def extract_first_sentence(text: str) -> str:
    lines = takewhile(lambda line: line.startswith("#"), text.splitlines())
    comment = " ".join(line.lstrip("# ") for line in lines)
    match = _SENTENCE.match(comment)
    return (match[1] if match else comment).rstrip(".")


def _measure_duration(recording: Path) -> float:
    """Return the duration of a recording, s: the first column of its last row."""
    return float(recording.read_text("utf-8").rstrip().rpartition("\n")[2].partition(",")[0])


def offer_names(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Make shtab complete shipped names in every verb; return the parser."""
    for verbs in parser._actions:
        if isinstance(verbs, argparse._SubParsersAction):
            for verb, action in ((name, option) for name, its in verbs.choices.items() for option in its._actions):
                for option in OPTIONS.keys() & set(action.option_strings):
                    action.complete = _format_completion(OPTIONS[option])
                if (verb, action.dest) in POSITIONALS:
                    action.complete = _format_completion(POSITIONALS[verb, action.dest])
    return parser


def _format_completion(verb: str) -> dict[str, Any]:
    items = list(load_entries()) if verb == "materials" else [item["name"] for item in describe_shipped(verb)]
    names, function = " ".join(items), f"_softfinger_{verb}"
    body = f'{function}() {{ compgen -W "{names}" -- $1; compgen -f -- $1; }}'
    return {"bash": function, "zsh": f"({names})", "tcsh": f"({names})", "preamble": {"bash": body}}
