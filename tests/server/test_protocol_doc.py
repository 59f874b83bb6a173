"""docs/protocol.md and the reference of telemetry against the code and against received messages."""

import inspect
import itertools
import re
import sys
from pathlib import Path

import msgpack
import numpy as np
import pytest
from helpers.daemons import make_daemon, subscribed
from helpers.programs import run_program
from helpers.telemetry_records import join, put, synthetic
from helpers.waits import WAIT_S, repeated

from softfinger.drivers.simulated.hand import SPEED_MAX_M_PER_S, TURN_MAX_RAD_PER_S
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.proxy.bodies import decode_motion
from softfinger.proxy.elastic.loads import ContactLoad
from softfinger.proxy.record import CAUSE_NAMES
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.services.command_handlers import EVENT_BYTES_MAX
from softfinger.server.services.monitoring import make_event_fields
from softfinger.server.socket_process.channel_messages import REQUEST_MAX
from softfinger.server.socket_process.command_clients import BURST, BURST_S, WAITING_MAX
from softfinger.server.socket_process.peer_socket import COMMANDS_MEMORY_MAX, FILES_MAX, HANDSHAKE_MS, MEMORY_MAX
from softfinger.server.socket_process.process import QUIET_S
from softfinger.server.socket_process.subscribers import SUBSCRIPTION_MAX
from softfinger.server.wire import commands, envelope, protocol
from softfinger.server.wire.control import AsyncControl, Control
from softfinger.server.wire.native import memory
from softfinger.server.wire.native.relay import CAPACITY_TICKS, WAKE_INTERVAL_MS
from softfinger.server.wire.process_link import LOG_PERIOD_S
from softfinger.server.wire.publisher import BACKLOG, LINGER_S, Publisher

DOCS = Path(__file__).parents[2] / "docs"
DOC = (DOCS / "protocol.md").read_text(encoding="utf-8")
TELEMETRY = (DOCS / "reference" / "telemetry.md").read_text(encoding="utf-8")
RECORD = (DOCS / "reference" / "record.md").read_text(encoding="utf-8")
HEADER = ("key", "type", "meaning")
KINDS = ("kind", *HEADER)
CODE_TABLES = {
    topic: getattr(protocol, f"{topic.upper()}_KEYS")
    for topic in ("contact", "event", "health", "state", "world", "deformation", "schema")
} | {f"event {kind}": keys for kind, keys in protocol.EVENT_EXTRA_KEYS.items()}


def split_cells(line):
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def read_tables(text, heading):
    tables, head = {}, None
    for line in text.split(f"{heading}\n", 1)[1].split("\n## ", 1)[0].splitlines():
        if not line.startswith("|"):
            head = None
        elif head is None:
            head = tuple(split_cells(line))
            tables[head] = []
        elif "---" not in line:
            tables[head].append(split_cells(line))
    return tables


def doc_tables():
    """Return the types by key for `contact`, `event`, ... in the reference; ticks have the record's keys."""
    tables = {}
    for topic in re.findall(r"^## `(\w+)`$", TELEMETRY, re.MULTILINE):
        below = read_tables(TELEMETRY, f"## `{topic}`")
        tables[topic] = {} if topic == "state" else {"`schema`": "int"}  # defined at the top of the page
        tables[topic] |= {key: kind.partition(",")[0] for key, kind, _ in below.pop(HEADER)}
        for kinds, key, kind, _ in below.pop(KINDS, []):
            for word in kinds.split(", "):
                tables.setdefault(f"{topic} {word.strip('`')}", {})[key] = kind.partition(",")[0]
        assert not below
    (record,) = [rows for head, rows in read_tables(RECORD, "# The record of a tick").items() if head == HEADER]
    tables["contact"] |= {key.replace("contacts0", "contacts[]"): kind.partition(",")[0] for key, kind, _ in record}
    return {title: {key.strip("`"): kind for key, kind in keys.items()} for title, keys in tables.items()}


def test_tables_list_the_keys_of_the_code():
    assert doc_tables() == {title: {key.name: key.type for key in keys} for title, keys in CODE_TABLES.items()}


def flatten(message, maps=(), prefix=""):
    """Return values by dotted key; the values of `maps` come from a client and are not flattened."""
    flat = {}
    for key, value in message.items():
        if isinstance(value, dict) and f"{prefix}{key}" not in maps:
            flat |= flatten(value, maps, f"{prefix}{key}.")
        elif value and isinstance(value, list) and isinstance(value[0], dict):
            flat |= flatten(value[0], maps, f"{prefix}{key}[].")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def type_name(value):
    if isinstance(value, list):
        (kind,) = {type(item).__name__ for item in value}
        return f"{kind}[{len(value) if kind != 'str' else ''}]"
    if isinstance(value, dict):
        return "map"
    return type(value).__name__


def real_messages():
    """Return at least one message per table, as a plain subscriber receives it, with the table's name."""
    records = synthetic(1500)
    put(records[10:], "contact.mode", 1)
    put(records[10:11], "contact.cause", CAUSE_NAMES.index("touch"))
    put(records[20:], "servo.guard", 1)
    put(records[25:], "contact.nonlinear", 4)
    put(records[30:], "servo.missed", 2)
    messages = []
    with (
        Publisher("tcp://127.0.0.1:*", guard_names=GUARD_NAMES, extra=protocol.SCENE_TOPICS) as publisher,
        subscribed(publisher.endpoint, *protocol.TOPICS[:-1], *protocol.SCENE_TOPICS) as socket,
    ):
        join(publisher, socket)
        socket.subscribe(protocol.SCHEMA_TOPIC)
        publisher.publish(records)
        puck = SystemDevice("hid", 0x046D, 0xC626, "SpaceNavigator", "", "/dev/hidraw0")
        publisher.event("device", "attached", **make_event_fields(puck))
        head = {"schema": protocol.SCHEMA, "timestamp": 1.7e9, "tick": 5}
        publisher.send_message("world", head | {"bodies": decode_motion(["box"], np.arange(14.0))})
        load = ContactLoad("", 0, (0.0, 0.0, -1.0), (0.0, 0.0, 0.02), 0.004)
        publisher.send_message("deformation", head | {"loads": [load._asdict()]})
        publisher.event("command", "arm", command_id="a1", what={"armed": True})
        publisher.event("mark", "mark", command_id="a2", label="x", data={"a": {"b": 1}})
        publisher.event("state", "armed", before="ready", cause="the force may be switched on")
        publisher.event("lifecycle", "stopped")
        while not {"schema", "event lifecycle"} <= {title for title, _ in messages}:
            assert socket.poll(1000.0 * WAIT_S)
            topic, body = socket.recv_multipart()
            message = msgpack.unpackb(body)
            messages.append((f"event {message['kind']}" if topic == b"event" else topic.decode(), message))
    return messages


@pytest.mark.real_time
def test_real_messages_have_the_documented_keys_and_types():
    tables = doc_tables()
    titles = set()
    for title, message in real_messages():
        documented = tables["event"] | tables.get(title, {}) if title.startswith("event") else tables[title]
        maps = [key for key, kind in documented.items() if kind == "map"]
        assert {key: type_name(value) for key, value in flatten(message, maps).items()} == documented
        titles.add(title)
    assert titles >= set(CODE_TABLES) - {"event"}


def test_numbers_in_the_text_equal_those_of_the_code():
    page = " ".join(DOC.split())  # independent of line breaks
    assert f"`schema` is {protocol.SCHEMA}." in page
    assert f"`state`: {protocol.STATE_HZ:g} times a second" in page and f"{CAPACITY_TICKS} ticks behind" in page
    assert f"about {WAKE_INTERVAL_MS} ms of their tick" in page
    assert f"the latest {CAPACITY_TICKS} rows" in page and f"| 1 | version of the layout, {memory.LAYOUT};" in page
    assert f"{BACKLOG} messages are queued" in page and f"if none was sent for {QUIET_S:g} s" in page
    assert f"a frame of {SUBSCRIPTION_MAX} bytes, {HANDSHAKE_MS / 1000.0:g} s for the handshake" in page
    assert f"About {FILES_MAX - 26} connections" in page  # less files of the publisher itself
    assert (MEMORY_MAX, COMMANDS_MEMORY_MAX) == (1 << 30, 1 << 28) and "than 1 GiB (command process: 256 MiB)" in page
    assert f"at most {LINGER_S:g} s after its last message" in page and f"once per {LOG_PERIOD_S:g} s" in page
    assert f"{REQUEST_MAX} bytes, {envelope.NODES_MAX} values and a depth of {envelope.DEPTH_MAX}" in page
    assert f"may send {BURST} requests per {BURST_S:g} s" in page and f"{WAITING_MAX} unread answers are queued" in page
    assert f"A frame of more than {REQUEST_MAX} bytes" in page and f"more than {EVENT_BYTES_MAX} bytes" in page
    assert f"at up to {SPEED_MAX_M_PER_S:g} m/s and {TURN_MAX_RAD_PER_S:g} rad/s" in page


def test_schema_of_the_commands_has_every_method():
    listed = commands.make_schema()["methods"]
    assert list(listed) == list(commands.METHODS)
    drive = listed["drive"]["params"]["$defs"]["Drive"]
    assert set(drive["properties"]) == {"object", "position_m", "orientation_wxyz"}
    assert drive["required"] == ["object", "position_m"] and drive["additionalProperties"] is False


def test_both_clients_have_every_method():
    for name in commands.METHODS:
        blocking, asynchronous = getattr(Control, name), getattr(AsyncControl, name)
        assert inspect.signature(blocking) == inspect.signature(asynchronous), name
        assert inspect.iscoroutinefunction(asynchronous), name


@pytest.mark.real_time
def test_command_program_on_the_page_runs():
    (program,) = [fence for fence in re.findall(r"```python\n(.*?)```", DOC, re.DOTALL) if "set_params" in fence]
    with make_daemon() as daemon:
        daemon.start()
        assert "tcp://127.0.0.1:5556" in program
        code = program.replace("tcp://127.0.0.1:5556", daemon.commands_endpoint)
        completed = run_program([sys.executable, "-c", code])
        assert daemon.rendering.scene.object[0].material.stiffness_n_per_m == 800.0, completed.stderr
    assert "'success': True" in completed.stdout


def test_wire_schema_holds_every_table():
    schema = protocol.describe_messages()
    assert schema["schema"] == protocol.SCHEMA
    listed = {name.replace(" of kind", ""): [key["name"] for key in keys] for name, keys in schema["messages"].items()}
    assert listed == {title: [key.name for key in keys] for title, keys in CODE_TABLES.items()}


@pytest.mark.real_time
def test_program_on_the_page_runs():
    program = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)[0]
    assert "tcp://127.0.0.1:5555" in program
    firsts = itertools.count(0, 50)
    with (
        Publisher("tcp://127.0.0.1:*") as publisher,
        repeated(lambda: publisher.publish(synthetic(50, first_tick=next(firsts))), 0.01),
    ):
        program = program.replace("tcp://127.0.0.1:5555", publisher.endpoint)
        completed = run_program([sys.executable, "-W", "error", "-c", program], check=True)
    ticks = [int(line.split()[0]) for line in completed.stdout.splitlines()]
    assert ticks and ticks == list(range(ticks[0], ticks[0] + len(ticks)))


def test_no_topic_is_a_prefix_of_another():
    """ZeroMQ filters by prefix, so such a topic would deliver both."""
    topics = (*protocol.TOPICS, *protocol.SCENE_TOPICS)
    assert not [(a, b) for a in topics for b in topics if a != b and b.startswith(a)]
