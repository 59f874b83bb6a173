"""Text of a device report: the content that an issue needs, and the open questions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softfinger.tools.exchange_figures import burst_line, table

Report = Mapping[str, Any]


def lines(report: Report, file: Path) -> list[str]:
    text = [f"device report of driver {report['driver']}, softfinger {report['softfinger']}: {report['ended']}"]
    if report["fault"] is not None:
        text.append(f"  fault: {report['fault']['message']}")
    if report["device"] is not None:
        text.append(f"  {report['device']['name']} at {report['rate_hz']:g} Hz, {report['system']['system']}")
    if report["freedom"]:
        text.append(f"  it moves {report['freedom']}")
    text += [f"  on {usb['bus']} {usb['vendor_id']}:{usb['product_id']} {usb['name']}" for usb in report["identity"]]
    text += _format_measured(report)
    if report["counts"]:
        text.append("  the driver counted: " + ", ".join(f"{name} {value}" for name, value in report["counts"].items()))
    if report["questions"] and report["device"] is not None:  # one that was opened
        text.append("only visible on hardware")
        for entry in report["questions"]:
            text += [f"  {entry['question']}", f"    {entry['answer']}"]
    text.append(f"the complete report is in {file}: attach it to an issue")
    return text


def _format_measured(report: Report) -> list[str]:
    text = []
    if report["exchange"] is not None:
        text += table(report["exchange"])
    if report["without_pauses"] is not None:
        text.append(burst_line(report["without_pauses"]))
    if (rest := report["rest"]) is not None:
        noise = ", ".join(f"{value * 1e6:.1f}" for value in rest["position_std_m"])
        handle = "at rest" if report["guided"] else "at the start, without a request to hold it still"
        text.append(f"  noise along x, y, z, {handle}: {noise} um")
    if (span := report["range"]) is not None:
        pairs = zip(span["position_min_m"], span["position_max_m"], strict=True)
        text.append("  was from " + ", ".join(f"{low * 1e3:.1f} to {high * 1e3:.1f}" for low, high in pairs) + " mm")
    for entry in report["moves"]:
        wanted = "" if entry["agrees"] else f", and {entry['expected']} was expected"
        text.append(f"  {entry['asked']}: {entry['seen']}{wanted}")
    if report["buttons"] is not None:
        text.append(f"  button masks: {', '.join(map(str, report['buttons']['masks']))}")
    for entry in report["pushes"]:
        answer = f"; felt: {entry['felt']}" if entry.get("felt") else ""
        text.append(f"  push along {entry['axis']}: {entry['seen']}{answer}")
    return text
