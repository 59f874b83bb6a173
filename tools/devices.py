"""`softfinger devices`: list of devices from `server.verbs.devices`, or a probe of a device."""

from __future__ import annotations

import argparse

from softfinger.config.errors import ConfigError
from softfinger.server.verbs import devices


def run(args: argparse.Namespace) -> int:
    if args.probe is not None:
        from softfinger.tools.doctor import probe  # compiles the exchange's loop, which a list does without

        return probe.run(args)
    if args.push:
        raise ConfigError("--push belongs to a probe: add --probe")
    return devices.run(args)
