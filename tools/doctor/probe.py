"""`devices --probe`: ten seconds of a device without force, shown briefly and written as a device report.

On request, one small push along each axis follows.
"""

from __future__ import annotations

import argparse
import sys
from typing import Final

import numpy as np

from softfinger.config.errors import ConfigError, DeviceNotFound
from softfinger.config.load import load_rig
from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import find_claim
from softfinger.tools.doctor import motions
from softfinger.tools.doctor.report import Report, ReportRequest, make_report
from softfinger.tools.doctor.session import TRANSLATIONS, DeviceSession
from softfinger.tools.exchange import START
from softfinger.tools.exchange_figures import summarize_part
from softfinger.tools.measure import Array
from softfinger.tools.options import PUSH_N

WORDS: Final = {"+x": "right", "+y": "away from you", "+z": "up", "-x": "left", "-y": "towards you", "-z": "down"}
PART_S: Final = 2.0
"""Duration of each of five parts: at rest, to the right, away, up, buttons. Ten seconds in all."""
PUSH_S: Final = 1.5
PUSH_PEAK: Final = 3.0 * 3.0**0.5 / 8.0
"""Largest value of one sine under its envelope, sin(pi s)^2 sin(2 pi s); it pushes along the axis and back."""


def run(args: argparse.Namespace) -> int:
    """Make the report of `--probe`; returns the exit code.

    Raises as `report.make_report`, and ConfigError if the rig allows less force than a push has.
    """
    rig = load_rig(args.rig if args.rig is not None else find_attached_rig())
    if args.push and rig.guard.force_max_n < PUSH_N:
        raise ConfigError(f"--push: guard.force_max_n = {rig.guard.force_max_n:g} is below the push of {PUSH_N:g} N")
    force_n, guided = PUSH_N if args.push else None, sys.stdin.isatty()
    request = ReportRequest("--probe", args.probe, "--push", force_n, PART_S, guided, args.json)
    return make_report(rig, request, ProbeSession, summarize)


def find_attached_rig() -> str:
    """Return the shipped rig of the first attached device that has one. Raises DeviceNotFound if there is none."""
    for device in discovery.list_attached():
        claim = find_claim(device)
        if claim is not None and claim.rigs:
            return claim.rigs[0]
    raise DeviceNotFound(
        "--probe: no attached device has a shipped rig: select your rig with --rig (`softfinger rigs` lists them)"
    )


class ProbeSession(DeviceSession):
    """Ten seconds of parts that follow each other without input from the user, then the pushes."""

    def run(self, force_n: float | None) -> None:
        self._print_freedom()
        self._ask(
            "ten seconds: 2 s each at rest, to the right, away from you, up, and for the buttons and turns. "
            "Keep the handle where each motion ends"
        )
        parts = [self._record_motion("hold still")]
        self._measure_rest(parts[0])
        supported = self._measure_translations()
        for motion in TRANSLATIONS:
            is_supported = motion in supported
            rows = self._record_motion(motion.words) if is_supported else self._record("further options", self._seconds)
            parts.append(rows)
            requested = self._guided and is_supported
            result = motions.measure_motion(motion.words, motion.kind, motion.expected, rows) if requested else None
            if result is not None:
                self._report["moves"].append(result)
        parts.append(self._record_motion("press each button in turn, and turn the handle"))
        together = join_rows(parts)
        if len(together):
            self._report["exchange"] = summarize_part(together, self._exchange.rate_hz)
            self._report["buttons"] = {"masks": motions.list_masks(together)}
        if force_n is not None:
            warning = f"hold the handle lightly: it pushes with {force_n:g} N along each axis and back"
            for axis, result in self._push_each(warning, force_n / PUSH_PEAK, 1.0 / PUSH_S, PUSH_S):
                self._report["pushes"].append(result | {"felt": self._ask_direction(motions.AXES[axis])})

    def _record_motion(self, words: str) -> Array:
        if self._guided and self._exchange.ended is None:
            print(words, file=sys.stderr, flush=True)
        return self._record(words, self._seconds)

    def _ask_direction(self, name: str) -> str:
        """Return the user's answer in one line; empty if the probe is not guided."""
        if not self._guided or self._exchange.ended is not None:
            return ""
        print(
            f"pushed along {name}: what did you feel? (right, left, away, towards me, up, down, nothing)",
            file=sys.stderr,
        )
        sys.stderr.flush()
        line = sys.stdin.readline()
        if not line:  # the terminal was closed
            raise KeyboardInterrupt
        return line.strip()[:80]


def join_rows(parts: list[Array]) -> Array:
    """Join rows of parts; the gaps between the parts are removed from their times."""
    all_rows: list[Array] = []
    begins = 0.0
    for rows in parts:
        if len(rows):
            later = rows.copy()
            later[:, START] += begins - rows[0, START]
            all_rows.append(later)
            begins = later[-1, START] + float(np.median(np.diff(rows[:, START]))) if len(rows) > 1 else begins
    return np.concatenate(all_rows) if all_rows else parts[0][:0]


def summarize(report: Report) -> list[str]:
    """Return the picture of the axes, and the most important figures for a user; nothing without an open device."""
    if report["device"] is None:
        return []
    text = draw_range(report)
    if (exchange := report["exchange"]) is not None:
        text.append(f"  {exchange['new_samples_hz']:.0f} new samples a second, the rig requires {report['rate_hz']:g}")
    return text


def draw_range(report: Report) -> list[str]:
    """Draw arrows of x, y and z with the range of the handle along each, and list the motions seen along each axis."""
    span = report["range"]
    reach = ["not seen"] * 3
    if span is not None:
        pairs = zip(span["position_min_m"], span["position_max_m"], strict=True)
        reach = [f"{low * 1e3:.1f} to {high * 1e3:.1f} mm" for low, high in pairs]
    x, y, z = (f"{name}  {WORDS[f'+{name}']}: {reach[k]}" for k, name in enumerate("xyz"))
    return [
        f"    ^ {z}",
        "    |",
        f"    |    7 {y}",
        "    |   /",
        "    |  /",
        "    | /",
        f"    +----------> {x}",
        *_measure_motions(report),
    ]


def _measure_motions(report: Report) -> list[str]:
    motions = []
    for move in report["moves"]:
        if move["kind"] == "translation":
            right = "as required" if move["agrees"] else f"WRONG: required is {move['expected']}"
            motions.append(f"    {WORDS[move['expected']]:>14} --> {move['seen']}   {right}")
    return motions
