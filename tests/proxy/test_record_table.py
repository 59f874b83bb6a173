"""Record table: a field added there appears in the record, the wire format, the result files and the schema."""

import shutil
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
from helpers.programs import run_program

from softfinger.proxy.kernels.model import NO_OUTCOME, Contact
from softfinger.proxy.kernels.record_writer import write_contact
from softfinger.proxy.record import AT, CAUSE_NAMES, FIELDS, NAMED, RECORD_SIZE, ContactMode, Kind
from softfinger.proxy.step_result import STEP_FIELDS, Step

ROOT = Path(__file__).parents[2]
NEW = '    fault_level: Annotated[int, 2, "float", "V", "rotor", "a field that a test has added"]\n'


def test_columns_follow_each_other():
    assert [field.at for field in FIELDS] == list(AT)
    ends = [field.at + field.size for field in FIELDS]
    assert [0, *ends] == [*AT, RECORD_SIZE]
    assert [field.name.replace(".", "_") for field in FIELDS] == list(AT._fields) and len(NAMED) == len(FIELDS)
    assert {field.kind for field in FIELDS} <= set(get_args(Kind))
    assert all(field.size == 1 for field in FIELDS if field.kind == "int")


def test_step_has_every_field_that_the_contact_fills():
    row = np.full(RECORD_SIZE, np.nan)
    types = get_type_hints(Contact).values()
    outcome = Contact(*((1.0, 1.0, 1.0) if part == tuple[float, float, float] else 1.0 for part in types))
    outcome = outcome._replace(contacts=(NO_OUTCOME,))
    force, orientation = (1.0, 1.0, 1.0), (1.0, 0.0, 0.0, 0.0)
    write_contact(row, 7, 0.001, force, orientation, outcome, force, force)
    filled = {f.name for f in FIELDS if not np.isnan(row[f.at : f.at + f.size]).any()}
    patches = {name for name in filled if name.startswith("contacts")}
    assert len(patches) == 18
    of_step = filled - patches - {"tick", "dt", "probe.position", "probe.orientation"}
    assert of_step == {f.name for f in STEP_FIELDS.values()}


def test_step_has_the_types_of_the_table():
    step = Step(np.arange(1.0, RECORD_SIZE + 1.0) % len(CAUSE_NAMES))
    assert step.cause in CAUSE_NAMES
    for name, field in STEP_FIELDS.items():
        value, row = getattr(step, name), step.record[field.at : field.at + field.size]
        if name != "cause":
            kinds = {"int": ContactMode if name == "mode" else int, "float": float}
            assert type(value) is (np.ndarray if field.size > 1 else kinds[field.kind]), name
            np.testing.assert_array_equal(value, row if field.size > 1 else row[0])


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """Copy of the program with one field added to the record table."""
    root = tmp_path_factory.mktemp("tree")
    package = root / "softfinger"
    shutil.copytree(ROOT / ".dev" / "softfinger", package, symlinks=False)
    table = package / "proxy" / "record.py"
    text = table.read_text(encoding="utf-8")
    last = text.index("\n\n\n", text.index("class Offsets")) + 1
    table.write_text(text[:last] + NEW + text[last:], encoding="utf-8")
    return root


EVERYWHERE = """
import json, sys
import numpy as np
from softfinger.drivers.poses import decode_messages
from softfinger.proxy.record import AT, FIELDS, NAMED, RECORD_SIZE, list_columns
from softfinger.server.cli import main
from softfinger.server.recording.results import read_results, write_blocks
from softfinger.server.socket_process.tick_messages import TickEncoder
from softfinger.server.socket_process.channel_messages import StateInfo, TickParameters
from softfinger.server.wire.client import record_of
from softfinger.server.wire.protocol import CONTACT, decode

assert FIELDS[-1] is NAMED["fault.level"] and AT.fault_level == RECORD_SIZE - 2
records = np.zeros((3, RECORD_SIZE))
records[:, AT.fault_level :] = (0.25, -0.5)

ticks = TickParameters(1, 1, [CONTACT], "state", 200.0)
_, body = next(TickEncoder(ticks, StateInfo()).encode_row(tuple(records[0].tolist())))
assert decode(CONTACT.encode(), body).fault.level == (0.25, -0.5)

for ending in ("csv", "npz", "mcap"):
    write_blocks(f"out.{ending}", [""], [records[:, None]])
    assert read_results(f"out.{ending}").tobytes() == records.tobytes(), ending
assert open("out.csv").readline().rstrip().endswith(",fault.level[0],fault.level[1]")
assert np.load("out.npz")["fault.level"].tolist() == [[0.25, -0.5]] * 3
assert [list(m.fault.level) for m in decode_messages("out.mcap")] == [[0.25, -0.5]] * 3

sys.exit(main(["schema", "telemetry"]))
"""


def test_new_field_is_everywhere(tree):
    environment = {"PYTHONPATH": str(tree), "HOME": str(tree), "PATH": "/usr/bin:/bin"}
    process = run_program([sys.executable, "-c", EVERYWHERE], cwd=tree, env=environment, check=True)
    assert '"fault.level"' in process.stdout and "a field that a test has added" in process.stdout
