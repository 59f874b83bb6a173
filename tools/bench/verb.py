"""`bench`: cost of a step, lateness of the servo, and duration of device exchange and telemetry."""

from __future__ import annotations

import argparse
import importlib
from typing import Final

KINDS: Final = {
    "step": ("softfinger.tools.bench.step", "cost of the contact step, back to back"),
    "closed-loop": ("softfinger.tools.bench.closed_loop", "ticks per second with a simulated device, offline"),
    "simulate": ("softfinger.tools.bench.simulate", "how fast `simulate` is, from its start to the file"),
    "loop": ("softfinger.tools.bench.loop", "lateness and execution time of the servo loop, beside a C loop"),
    "device": ("softfinger.tools.bench.device", "time of an exchange with a device, beside one that does nothing"),
    "commands": (
        "softfinger.tools.bench.commands",
        "what commands do to a hand that presses: torn sets, steps, memory",
    ),
    "mesh": ("softfinger.tools.bench.mesh", "cost of a tick on a mesh, by its size"),
    "view": ("softfinger.tools.bench.view", "what pages cost the servo, and how many pictures a second they draw"),
    "soak": ("softfinger.tools.bench.soak", "a long run with everything on: what grows, what is missed or lost"),
    "telemetry": ("softfinger.tools.bench.telemetry", "time from tick to subscriber, and what was lost"),
}


def configure(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    for name, (module_name, text) in KINDS.items():
        kind = kinds.add_parser(name, help=text, description=f"softfinger bench {name}: {text}.")
        module = importlib.import_module(module_name)
        module.configure(kind)
        kind.set_defaults(measure=module.run)


def run(args: argparse.Namespace) -> int:
    code: int = args.measure(args)
    return code
