"""Questions that only hardware can answer (questions.toml), and the answers that a report has measured."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, NamedTuple

FILE: Final = Path(__file__).with_name("questions.toml")
FAST_HZ: Final = 4000.0

Report = Mapping[str, Any]


class HardwareQuestion(NamedTuple):
    """Question with its id, the drivers that it concerns, and a way for a user to answer it."""

    id: str
    drivers: tuple[str, ...]
    question: str
    how: str


@cache
def load_questions() -> tuple[HardwareQuestion, ...]:
    rows = tomllib.loads(FILE.read_text(encoding="utf-8"))["question"]
    return tuple(HardwareQuestion(row["id"], tuple(row["drivers"]), row["question"], row["how"]) for row in rows)


def answer_questions(report: Report) -> list[dict[str, Any]]:
    """Return the questions of a report's driver, each with the measured answer or instructions to measure it."""
    answers = []
    for question in load_questions():
        if report["driver"] in question.drivers:
            answer = ANSWERS[question.id](report) if question.id in ANSWERS else None
            row = {"id": question.id, "question": question.question, "measured": answer is not None}
            answers.append(row | {"answer": answer if answer is not None else f"not answered: {question.how}"})
    return answers


def _answer_exchange(report: Report) -> str | None:
    if (exchange := report["exchange"]) is None:
        return None
    read, write = exchange["read"], exchange["write"]
    return (
        f"read {_format_us(read['p50'])} (p99 {_format_us(read['p99'])}), "
        f"write {_format_us(write['p50'])} (p99 {_format_us(write['p99'])}), "
        f"{exchange['new_samples_hz']:.0f} new samples a second at {report['rate_hz']:g} Hz"
    )


def _answer_moves(kind: str, report: Report) -> str | None:
    moves = [move for move in report["moves"] if move["kind"] == kind]
    return "; ".join(f"{move['asked']}: {move['seen']}" for move in moves) or None


def _answer_buttons(report: Report) -> str | None:
    buttons = report["buttons"]
    if buttons is None:
        return None
    return f"masks {', '.join(map(str, buttons['masks']))} were seen" if any(buttons["masks"]) else "none was seen"


def _answer_force_sign(report: Report) -> str | None:
    return "; ".join(f"force along {push['axis']}: {push['seen']}" for push in report["pushes"]) or None


def _answer_unplugged(report: Report) -> str | None:
    fault = report["fault"]
    return fault["message"] if fault is not None and fault["kind"] == "DeviceLost" else None


def _answer_library(report: Report) -> str | None:
    return ", ".join(report["maker_library"]) or None


def _answer_fast(report: Report) -> str | None:
    return _answer_exchange(report) if report["rate_hz"] >= FAST_HZ else None


def _answer_force_on(report: Report) -> str | None:
    period = report["options"].get("status_period_s", 0.05)
    if report["exchange"] is None or report["exchange"]["seconds"] <= period:
        return None
    if report["fault"] is None:
        return f"yes, within status_period_s = {period:g}: later it was not found to be anything else"
    return f"the report ended: {report['fault']['message']}" if report["fault"]["in_use"] else None


def _answer_guarded_counts(report: Report) -> str | None:
    counts = report["counts"]
    if "writes_guarded" not in counts:
        return None
    forces, reads = (f"{counts[f'{kind}_guarded']} of {counts[kind]} {kind}" for kind in ("writes", "reads"))
    return f"{forces}, {reads}"


def _answer_descriptor(report: Report) -> str | None:
    texts = [device["report_descriptor"] for device in report["identity"] if device.get("report_descriptor")]
    return "; ".join(texts) or None


def _answer_ids(report: Report) -> str | None:
    return ", ".join(f"{device['vendor_id']}:{device['product_id']}" for device in report["identity"]) or None


def _format_us(seconds: float) -> str:
    return f"{seconds * 1e6:.1f} us"


ANSWERS: Final[Mapping[str, Callable[[Report], str | None]]] = {
    "exchange-time": _answer_exchange,
    "frame": partial(_answer_moves, "translation"),
    "rotation": partial(_answer_moves, "rotation"),
    "buttons": _answer_buttons,
    "force-sign": _answer_force_sign,
    "unplugged": _answer_unplugged,
    "fd-library": _answer_library,
    "fd-fast": _answer_fast,
    "fd-force-on": _answer_force_on,
    "fd-held-back": _answer_guarded_counts,
    "hid-descriptor": _answer_descriptor,
    "hid-write": _answer_exchange,
    "serial-ids": _answer_ids,
}
"""Functions that return the answer in a report, None if it was not measured."""
