"""Files of injected faults: accepted contents and errors."""

import re
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from helpers.refusals import refusal
from hypothesis import given
from hypothesis import strategies as st

from softfinger.config import limits
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, load_faults
from softfinger.config.schema import Faults, Injection
from softfinger.config.sources import list_shipped
from softfinger.drivers.fault_injector import END_TICK, FIRST_TICK, PERIOD_TICKS, make_fault_table

pytestmark = pytest.mark.plain


PAGE = Path(__file__).resolve().parents[2] / "docs" / "operate" / "faults.md"
KINDS = {kind.kind for kind in get_args(Injection)}


def faults(**keys: Any) -> Faults:
    return build(Faults, {"fault": [{"kind": "stale", **keys}]}, "faults")


def test_a_file_is_shipped_for_every_kind() -> None:
    assert {fault.kind for name in list_shipped(Faults) for fault in load_faults(name).fault} == KINDS


def test_the_page_lists_every_kind() -> None:
    rows = re.findall(r"^\| (`.+`) \| .* \| .* \|$|^\| (`.+?`) \|", PAGE.read_text("utf-8"), re.MULTILINE)
    assert {name for row in rows for name in re.findall(r"`(\w+)`", "".join(row))} - {"kind"} == KINDS


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({}, r"fault\[0\]\.at_tick: is missing, as is at_s: set one of them"),
        ({"at_tick": 5, "at_s": 1.0}, r"fault\[0\]\.at_s = 1\.0: at_tick already sets the start"),
        ({"at_tick": 5, "ticks": 3, "for_s": 1.0}, r"fault\[0\]\.for_s = 1\.0: ticks already sets the duration"),
        ({"at_tick": -1}, r"fault\[0\]\.at_tick = -1: must be an integer from 0"),
        ({"at_s": 1.0, "kind": "stael"}, r"fault\[0\]\.kind = 'stael'.*did you mean 'stale'"),
        ({"at_s": 1.0, "offset_m": [0, 0, 1]}, r"fault\[0\]\.offset_m"),
        ({"at_s": 1.0, "kind": "teleport"}, r"fault\[0\]\.offset_m.* is missing"),
        ({"at_s": 1.0, "kind": "slow", "block_s": 1e9}, r"fault\[0\]\.block_s = 1000000000\.0: must be .* 60 s"),
        ({"at_s": 1.0, "kind": "nan", "number": "w"}, r"fault\[0\]\.number = 'w': must be"),
    ],
)
def test_a_fault_is_reported_with_its_key(keys: dict[str, Any], words: str) -> None:
    message = refusal(faults, **keys)
    assert re.search(words, message) and "\n" not in message


def test_an_unknown_name_is_reported_with_a_similar_one() -> None:
    assert re.search(r"no file of faults is called 'teleprt'.*did you mean 'teleport'", refusal(load_faults, "teleprt"))


@pytest.mark.parametrize(
    ("keys", "window"),
    [
        ({"at_tick": 7}, (7, 8)),
        ({"at_tick": 7, "ticks": 3}, (7, 10)),
        ({"at_s": 0.1}, (200, 201)),
        ({"at_s": 0.1, "for_s": 0.01}, (200, 220)),
        ({"at_tick": 7, "for_s": 0.0001}, (7, 8)),  # part of a period is one
    ],
)
def test_times_become_ticks_of_the_rate(keys: dict[str, Any], window: tuple[int, int]) -> None:
    (row,) = make_fault_table(faults(**keys, every_ticks=2).fault, 2000.0)
    assert (row[FIRST_TICK], row[END_TICK], row[PERIOD_TICKS]) == (*window, 2)


VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(-(1 << 70), 1 << 70), st.floats(), st.text(max_size=5),
    st.sampled_from(["read", "write", "x", "qz", *sorted(KINDS)]), st.lists(st.floats(), max_size=4),
)  # fmt: skip
KEYS = sorted({"what", *(name for kind in get_args(Injection) for name in kind.__struct_fields__)})


@given(st.lists(st.dictionaries(st.sampled_from(["kind", *KEYS]), VALUES, max_size=5) | VALUES, max_size=3) | VALUES)
def test_a_random_file_is_refused_with_its_name(tables: Any) -> None:
    """An accepted file has at least a kind and a start, which are hardly ever drawn together."""
    try:
        build(Faults, {"fault": tables}, "my-faults.toml")
    except ConfigError as error:
        assert "my-faults.toml: fault" in str(error)  # noqa: PT017


def within(span: limits.Range) -> st.SearchStrategy[Any]:
    return st.integers(span.low, span.high) if isinstance(span.low, int) else st.floats(span.low, span.high)


TICK, TIME_S = within(limits.FAULT_TICK), within(limits.FAULT_TIME_S)


@given(
    st.fixed_dictionaries({"at_tick": TICK}) | st.fixed_dictionaries({"at_s": TIME_S}),
    st.just({}) | st.fixed_dictionaries({"ticks": TICK}) | st.fixed_dictionaries({"for_s": TIME_S}),
    within(limits.FAULT_EVERY), within(limits.RATE_HZ),
)  # fmt: skip
def test_every_accepted_time_is_a_window(start: dict[str, Any], span: dict[str, Any], every: int, rate_hz: float):
    table = make_fault_table(faults(**start, **span, every_ticks=every).fault, rate_hz)
    first, end, period = table[:, [FIRST_TICK, END_TICK, PERIOD_TICKS]].T
    assert np.isfinite([first, end, period]).all() and (first <= end).all() and (period >= 1).all()
