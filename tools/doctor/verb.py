"""`softfinger doctor`: checks of the machine, or a report of the device of a rig."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

from softfinger.config.errors import ConfigError, Unfit
from softfinger.config.load import load_rig, load_scene
from softfinger.config.schema import Rig, Scene
from softfinger.server.loop.servo_thread import require_machine_code
from softfinger.server.progress import map_with_progress
from softfinger.tools.doctor import attached, loop, machine, report
from softfinger.tools.doctor.machine import STATES, Check, format_lines
from softfinger.tools.measure import show


def run(args: argparse.Namespace) -> int:
    """Check or report; returns the exit code. Raises Unfit if a check is bad, after printing all of them."""
    require_machine_code("the doctor")
    if args.device_report is not None:
        return report.run(args)
    if args.with_force is not None or args.no_prompts:
        raise ConfigError("--with-force and --no-prompts belong to a report: add --device-report")
    rig = load_rig(args.rig)
    result = examine(rig, load_scene(args.scene), args.rig, args.scene, args.seconds, args.plot)
    checks = [Check(**entry) for entry in result["checks"]]
    head = f"softfinger on this machine, for rig {args.rig} at {rig.servo.rate_hz:g} Hz and scene {args.scene}"
    tail = "  " + ", ".join(f"{result['states'][state]} {state}" for state in STATES)
    show(result, args.json, [head, *format_lines(checks), tail])
    if bad := [check.name for check in checks if check.state == "bad"]:
        raise Unfit(f"{len(bad)} of {len(checks)} checks failed: {', '.join(bad)}: see the remedy of each")
    return 0


def examine(
    rig: Rig, scene: Scene, rig_name: str, scene_name: str, seconds: float, plot: Path | None
) -> dict[str, Any]:
    """Return every check, and the figures behind the measured ones; draw the lateness to `plot`.

    Both names are for messages.
    """
    figures: dict[str, Any] = {}

    def lateness() -> list[Check]:
        late, measured = loop.measure_lateness(rig, scene, seconds, plot)
        figures.update(measured)
        return late

    steps: tuple[Callable[[], list[Check]], ...] = (
        machine.list_checks,
        lambda: loop.check_settings(rig),
        lambda: [loop.check_cache(rig, scene_name, scene)],
        lateness,
        lambda: [loop.check_step(rig, scene_name, scene)],
        lambda: [loop.check_endpoint(rig)],
        lambda: attached.list_checks(rig),
    )
    checks = list(chain(*map_with_progress("checking the machine", lambda step: step(), steps)))
    counted = Counter(check.state for check in checks)
    return {
        "rig": rig_name,
        "scene": scene_name,
        "states": {state: counted[state] for state in STATES},
        "checks": [check._asdict() for check in checks],
        "loop": figures,
    }
