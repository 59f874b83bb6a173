"""`keys`: CURVE key pairs, with which a daemon and its clients on other machines authenticate each other."""

from __future__ import annotations

import argparse
import json

from softfinger.server.keys import make_pair


def run(args: argparse.Namespace) -> int:
    pairs = {name: make_pair(args.folder, name) for name in args.names}
    if args.json:
        print(json.dumps({name: {"public": str(p), "secret": str(s)} for name, (p, s) in pairs.items()}))
    else:
        for public, secret in pairs.values():
            print(f"{public}: public key: copy it to the other side\n{secret}: secret key: do not share it")
    return 0
