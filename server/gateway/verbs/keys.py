"""`keys`: CURVE key pairs, with which a daemon and its clients on other machines authenticate each other."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from softfinger.server.keys import make_pair


def configure(parser: argparse.ArgumentParser) -> None:
    """Define the arguments of the verb."""
    parser.description = (
        "Make a key pair for each name: NAME.key, which is public, and NAME.key_secret (mode 600), which is "
        "secret. Existing files are not overwritten."
    )
    parser.add_argument("folder", type=Path, help="where to; made if it is not there")
    parser.add_argument("names", nargs="+", metavar="NAME", help="of a machine or a person")
    parser.add_argument("--json", action="store_true", help="print the files as JSON")


def run(args: argparse.Namespace) -> int:
    """Create the pairs and print their files; returns 0."""
    made = {name: make_pair(args.folder, name) for name in args.names}
    if args.json:
        print(json.dumps({name: {"public": str(p), "secret": str(s)} for name, (p, s) in made.items()}))
    else:
        for public, secret in made.values():
            print(f"{public}: public: give it to the other side\n{secret}: secret: share it with no one")
    return 0
