"""docs/protocol.md against the code and against messages as they arrive."""

import re
import subprocess
import sys
import threading
from pathlib import Path

import msgpack
import pytest
import zmq
from telemetry_records import join, put, synthetic

from softfinger.drivers.discovery import Attached
from softfinger.proxy.state import CAUSE_NAMES
from softfinger.server.guard import GUARD_NAMES
from softfinger.server.hotplug import described
from softfinger.server.protocol import (
    CONTACT_KEYS,
    EVENT_EXTRA_KEYS,
    EVENT_KEYS,
    HEALTH_KEYS,
    SCHEMA,
    TOPICS,
    wire_schema,
)
from softfinger.server.telemetry import BACKLOG, Publisher

DOC = (Path(__file__).parents[1] / "docs" / "protocol.md").read_text(encoding="utf-8")
HEADER = ["key", "type", "unit", "frame", "meaning"]
CODE_TABLES = {
    "contact": CONTACT_KEYS,
    "event": EVENT_KEYS,
    "health": HEALTH_KEYS,
    **{f"event {kind}": keys for kind, keys in EVENT_EXTRA_KEYS.items()},
}


def cells(line):
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def doc_tables():
    """Rows of each table of the page, by the heading it stands under: `contact`, `event`, `event guard`, ..."""
    tables, topic, title = {}, "", ""
    for line in DOC.splitlines():
        if heading := re.match(r"## `(\w+)`", line):
            topic = title = heading[1]
        elif heading := re.match(r"### Kinds? `(\w+)`", line):
            title = f"{topic} {heading[1]}"
        elif line.startswith("|"):
            tables.setdefault(title, []).append(cells(line))
    return tables


def test_tables_have_the_agreed_columns():
    """Each table has the header key, type, unit, frame, meaning, so that the other tests read what they think."""
    tables = doc_tables()
    assert set(tables) == set(CODE_TABLES)
    for rows in tables.values():
        assert rows[0] == HEADER
        assert all(len(row) == len(HEADER) for row in rows)


@pytest.mark.parametrize("title", CODE_TABLES)
def test_table_is_the_codes_table(title):
    """Keys, types, units, frames and meanings of the page are those of the code, in its order."""
    documented = ["| " + " | ".join(row) + " |" for row in doc_tables()[title][2:]]
    expected = [f"| `{k.name}` | {k.type} | {k.unit} | {k.frame} | {k.meaning} |" for k in CODE_TABLES[title]]
    assert documented == expected, "the table should read:\n" + "\n".join(expected)


def flatten(message, prefix=""):
    flat = {}
    for key, value in message.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def type_name(value):
    if isinstance(value, list):
        (kind,) = {type(item).__name__ for item in value}
        return f"{kind}[{len(value)}]"
    return type(value).__name__


def real_messages():
    """At least one message of each table, as a plain subscriber receives it, with the table's name."""
    records = synthetic(1500)
    put(records[10:], "contact.mode", 1)
    put(records[10:11], "contact.cause", CAUSE_NAMES.index("touch"))
    put(records[20:], "servo.guard", 1)
    put(records[30:], "servo.missed", 2)
    found = []
    context = zmq.Context.instance()
    with Publisher("tcp://127.0.0.1:*", guard_names=GUARD_NAMES) as publisher, context.socket(zmq.SUB) as socket:
        socket.rcvhwm = 10_000
        socket.subscribe("")
        socket.connect(publisher.endpoint)
        join(publisher, socket)
        publisher.publish(records)
        puck = Attached("hid", 0x046D, 0xC626, "SpaceNavigator", "", "/dev/hidraw0")
        publisher.event("device", "attached", **described(puck))
        publisher.event("lifecycle", "stopped")
        while not found or found[-1][0] != "event lifecycle":
            assert socket.poll(5000)
            topic, body = socket.recv_multipart()
            message = msgpack.unpackb(body)
            found.append((f"event {message['kind']}" if topic == b"event" else topic.decode(), message))
    return found


def test_real_messages_have_the_documented_keys_and_types():
    """Every message has exactly the keys of its tables, each with a value of the type written there."""
    tables = {title: {row[0].strip("`"): row[1] for row in rows[2:]} for title, rows in doc_tables().items()}
    seen = set()
    for title, message in real_messages():
        documented = tables["event"] | tables.get(title, {}) if title.startswith("event") else tables[title]
        assert {key: type_name(value) for key, value in flatten(message).items()} == documented
        seen.add(title)
    assert seen >= set(CODE_TABLES) - {"event"}


def test_lists_and_numbers_in_the_text_are_the_codes():
    """Schema, backlog, causes and guard bits are those of the code."""
    assert f"`schema` is {SCHEMA}." in DOC
    assert f"{BACKLOG} messages are kept" in DOC
    causes = ", ".join(f"{value} `{name}`" for value, name in enumerate(CAUSE_NAMES))
    assert f"`contact.cause`: {causes}." in DOC
    bits = ", ".join(f"{1 << bit} `{name}`" for bit, name in enumerate(GUARD_NAMES))
    assert f"lowest first: {bits}." in DOC


def test_wire_schema_holds_every_table():
    """The schema that the program prints lists the same messages and keys."""
    schema = wire_schema()
    assert schema["schema"] == SCHEMA
    listed = {name.replace(" of kind", ""): [key["name"] for key in keys] for name, keys in schema["messages"].items()}
    assert listed == {title: [key.name for key in keys] for title, keys in CODE_TABLES.items()}


@pytest.mark.parametrize("index", [0, 1])
def test_program_on_the_page_runs(index):
    """Both client programs, with the endpoint put in, receive ticks from a real publisher and end."""
    program = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)[index]
    assert "tcp://127.0.0.1:5555" in program
    stop = threading.Event()

    def publish(publisher):
        # Until the program has what it wants: when it connects is up to the machine.
        first = 0
        while not stop.wait(0.01):
            publisher.publish(synthetic(50, first_tick=first))
            first += 50

    with Publisher("tcp://127.0.0.1:*") as publisher:
        thread = threading.Thread(target=publish, args=(publisher,))
        thread.start()
        try:
            done = subprocess.run(
                [sys.executable, "-W", "error", "-c", program.replace("tcp://127.0.0.1:5555", publisher.endpoint)],
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
        finally:
            stop.set()
            thread.join()
    assert done.returncode == 0, done.stderr
    ticks = [int(line.split()[0]) for line in done.stdout.splitlines()]
    assert len(ticks) > 0
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))


def test_no_topic_begins_another():
    """ZeroMQ filters by prefix, so a topic that begins another would bring both."""
    assert not [(a, b) for a in TOPICS for b in TOPICS if a != b and b.startswith(a)]
