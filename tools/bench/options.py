"""`softfinger bench`: its measurements; the module of the chosen one is imported and adds its options."""

from __future__ import annotations

import argparse
import importlib
from functools import partial
from typing import Final

KINDS: Final = {
    "step": ("softfinger.tools.bench.step", "cost of the contact step, back to back"),
    "closed-loop": ("softfinger.tools.bench.closed_loop", "ticks per second with a simulated device, offline"),
    "simulate": ("softfinger.tools.bench.simulate", "how fast `simulate` is, from its start to the file"),
    "loop": ("softfinger.tools.bench.loop", "lateness and execution time of the servo loop, compared with a C loop"),
    "device": ("softfinger.tools.bench.device", "time of an exchange with a device, compared with an empty one"),
    "commands": (
        "softfinger.tools.bench.commands",
        "effect of commands on a pressing hand: torn sets, steps, memory",
    ),
    "mesh": ("softfinger.tools.bench.mesh", "cost of a tick on a mesh, by its size"),
    "view": ("softfinger.tools.bench.view", "cost of pages for the servo, and their frame rate"),
    "soak": (
        "softfinger.tools.bench.soak",
        "a long run with all services: growth of memory, missed ticks, lost records",
    ),
    "telemetry": ("softfinger.tools.bench.telemetry", "time from tick to subscriber, and lost records"),
}


def configure_bench(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    for name, (module, text) in KINDS.items():
        description = f"softfinger bench {name}: {text}."
        kinds.add_parser(name, help=text, description=description, configure=partial(configure_kind, module))


def configure_kind(module_name: str, parser: argparse.ArgumentParser) -> None:
    """Add the options of one measurement."""
    module = importlib.import_module(module_name)
    module.configure(parser)
    parser.set_defaults(measure=module.run)


def run(args: argparse.Namespace) -> int:
    code: int = args.measure(args)
    return code
