"""The reference pages of docs/, made from the schema, the record table and the table of commands: `make reference`.

python -m softfinger.tools.pages.reference docs/reference
"""

from __future__ import annotations

import argparse
import json
import sys
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from softfinger.config.materials import flatten_entry, load_papers
from softfinger.drivers import registry
from softfinger.proxy.record import CAUSE_NAMES, FIELDS, MODE_NAMES, Field
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.offline import library_texts
from softfinger.server.verbs import schema, shipped
from softfinger.server.wire import commands, protocol
from softfinger.server.wire.protocol import Key
from softfinger.tools.pages import states
from softfinger.tools.pages.hazards import HAZARDS, RESULTS_FILE, Hazard

WIDTH: Final = 120
GENERATED_NOTE: Final = "<!-- made by `make reference`; change the program, not this file -->"

_KEYS: Final = """\
Units are SI and end each key. Neither a file nor a flag widens a range. A text has its length. A key without
*required* or a default may be omitted. `[[name]]` may be repeated."""


def make_scenes_page() -> str:
    head = f"""\
# Scenes: every key

A scene file (TOML) describes the fingertips, the objects and the effects: [write a scene](../operate/scenes.md).
`softfinger schema scene` prints these tables as JSON Schema. {_KEYS} A relative path of a file starts at the scene's
folder."""
    return _make_page(head, "## Shipped scenes", _format_list("scenes"), "## Keys", schema.format_markdown("scene"))


def make_rigs_page() -> str:
    head = f"""\
# Rigs: every key

A rig file (TOML) names the device and sets the servo loop, the safety limits and the interfaces: [write a
rig](../operate/scenes.md#write-a-rig). [Each driver](drivers.md) has further keys. `softfinger schema rig` prints these
tables as JSON Schema. {_KEYS}"""
    return _make_page(head, "## Shipped rigs", _format_list("rigs"), "## Keys", schema.format_markdown("rig"))


def make_drivers_page() -> str:
    """Return the page with every key of every driver; tables shared by two drivers are printed once."""
    head = """\
# Drivers: every key

Keys of a rig's `[device]` besides `driver`; several devices have a table `[devices.NAME]` each.
[Devices](../devices/overview.md) shows their use."""
    parts, anchors = [], dict[str, str]()
    for name in registry.BUILT_IN:
        parts.append(f"## `{name}`")
        for heading, body in schema.list_sections(registry.load(name).Options, "[device]"):
            parts.append(f"### {heading}\n\n{f'As {anchors[body]}.' if body in anchors else body}")
            anchors.setdefault(body, f"{heading} of `{name}`")
    return _make_page(head, *parts)


def make_experiments_page() -> str:
    head = f"""\
# Experiments: every key

An experiment file (TOML) describes trials and answers: [run an experiment](../run-an-experiment.md).
`softfinger schema experiment` prints these tables as JSON Schema. {_KEYS}"""
    folder_files = schema.format_grid(
        ["file", "content"], [[f"`{name}`", content] for name, content in _FOLDER_FILES.items()]
    )
    return _make_page(
        head, "## Shipped experiments", _format_list("experiments"), "## Keys", schema.format_markdown("experiment"),
        "## Files of the folder", "No file of a participant is overwritten.", folder_files,
    )  # fmt: skip


_FOLDER_FILES: Final = {
    "experiment.json": "the experiment; the folder refuses another one",
    "files.json": "hashes of the experiment's scenes, rig and images, and of meshes, maps, textures and models of its "
    "scenes; the folder refuses changed files",
    "dataset_description.json": "title and version of BIDS, which defines the file names",
    "trials.csv, participants.tsv": "a row per trial of all participants, made from the journals",
    "surveys.csv": "a row per answer to a question of a survey; `sub-01/sub-01_surveys.csv` for one participant",
    "figures/": "output of `softfinger figure`: figures, numbers, `report.html`",
    "sub-01/sub-01_journal.jsonl": "every event, a line each: the source of all tables",
    "sub-01/sub-01_design.json, sub-01_order.csv": "seed, conditions, the order of trials",
    "sub-01/sub-01_trials.csv": "a row per trial",
    "sub-01/sub-01_run-01_ticks.mcap": "every tick and marker of a start: [recordings](../operate/recordings.md)",
    "sub-01/sub-01_run-01_about.json": "versions, rig, scene, device of a start",
    "sub-01/sub-01_run-01_doctor.json": "result of [doctor](../operate/doctor.md)",
    "sub-01/trials/sub-01_trial-0001.csv": "every tick of the touches of a trial",
}


def make_record_page() -> str:
    head = """\
# The record of a tick

Every tick of the servo loop writes one record. Results files, recordings and `Engine.run` have its fields as
columns, in this order; a field of several components has the columns `name[0]`, `name[1]`, ...
[Telemetry](telemetry.md) publishes the same fields. A type has its unit and, of a vector, its frame. `contacts0` is
the contact with the largest load; `contacts1` and `contacts2` are further ones, with the same fields. The object of an
unused one is -1."""
    numbered = [
        ("`contact.mode`", enumerate(MODE_NAMES)),
        ("`contact.cause`", enumerate(CAUSE_NAMES)),
        ("bits of `servo.guard`", ((1 << bit, name) for bit, name in enumerate(GUARD_NAMES))),
    ]
    numbers = "\n".join(f"- {title}: {_format_numbers(values)}." for title, values in numbered)
    rows = [Key(field.name, _format_kind(field), field.unit, field.frame, field.meaning) for field in FIELDS]
    once = [row for row in rows if not row.name.startswith(("contacts1", "contacts2"))]
    return _make_page(head, format_keys_table(once), "## Numbers", numbers)


def make_telemetry_page() -> str:
    head = f"""\
# Telemetry: every key

Each message has two frames, a topic and a msgpack map. A dot in a key stands for a map within a map, `[]` for a
list of maps; a type has its unit and, of a vector, its frame. All but `state` have `schema`: {protocol.SCHEMA}, the
version of the [protocol](../protocol.md), which explains sockets, topics, losses and when each event is sent."""
    contact = """\
The fields of [the record](record.md) under their names, with the list `contacts` in place of `contacts0` to
`contacts2`. Several fingers have the topic `finger/NAME` each, with the same keys. Besides:"""
    kinds = """\
Keys that events of single kinds add. Other kinds add what the event needs."""
    tables = {
        "`state`": protocol.STATE_KEYS,
        "`event`": protocol.EVENT_KEYS,
        "`health`": protocol.HEALTH_KEYS,
        "`world`": protocol.WORLD_KEYS,
        "`deformation`": protocol.DEFORMATION_KEYS,
        "`schema`": protocol.SCHEMA_KEYS,
    }
    names = {field.name for field in FIELDS}
    unrecorded = [key for key in protocol.CONTACT_KEYS if key.name.replace("[]", "0") not in names]
    parts = ["## `contact`", " ".join(contact.split()), format_keys_table(unrecorded)]
    for title, keys in tables.items():
        parts += [f"## {title}", format_keys_table(keys)]
        if keys is protocol.EVENT_KEYS:
            parts += [kinds, _format_kinds(protocol.EVENT_EXTRA_KEYS)]
    return _make_page(head, *parts)


def _format_kinds(kinds: Mapping[str, Iterable[Key]]) -> str:
    """Return a table of keys of events with their kinds; a key that several kinds share is printed once."""
    of: dict[Key, list[str]] = {}
    for kind, keys in kinds.items():
        for key in keys:
            of.setdefault(key, []).append(f"`{kind}`")
    rows = [[", ".join(names), f"`{key.name}`", _format_type(key), key.meaning] for key, names in of.items()]
    return schema.format_grid(["kind", "key", "type", "meaning"], rows)


def make_commands_page() -> str:
    head = """\
# Commands: every method

[Commands to a running daemon](../operate/commands.md) shows their use, [the protocol](../protocol.md#commands) the
messages. Units are SI. A key in brackets may be omitted. `object` and `finger` are a name or an index."""
    results = Counter(method.result for method in commands.METHODS.values())
    shared = [kind for kind, times in results.items() if times > 1]
    parts = []
    for name, (params, result, meaning) in commands.make_table().items():
        method = commands.METHODS[name]
        takes = f"- takes {params}. {_describe_type(method.params)}" if params else ""
        gives = f"- gives {result}. {'' if method.result in shared else _describe_type(method.result)}"
        parts += [f"### `{name}`", meaning, "\n".join(filter(None, [takes, gives.strip()]))]
    shared_results = schema.format_grid(
        ["keys", "meaning"], [[commands.describe_fields(kind), _describe_type(kind)] for kind in shared]
    )
    errors = schema.format_grid(
        ["name", "meaning"], [[f"`{name}`", meaning] for name, meaning in commands.ERRORS.items()]
    )
    results_of = ["## Results of several methods", shared_results]
    return _make_page(
        head, "## Methods", *parts, *results_of, "## Errors", "The text of an error begins with its name.", errors
    )


def make_states_page() -> str:
    head = """\
# States: every transition

A daemon is in one of these states. `health.state` and the command `describe` have it, each change is an event of
kind `state`, and Prometheus has `softfinger_state`. There are no other transitions. `arm` in [`[guard]`](rigs.md)
selects how the force is armed; [Safety](../safety.md) describes faults."""
    state_table, transition_table = states.format_tables()
    figure = "![states of the daemon, and what leads from one to another](../figures/states.svg)"
    return _make_page(head, figure, "## States", state_table, "## Transitions", transition_table)


def make_faults_page() -> str:
    head = """\
# Faults: every hazard

Each hazard with its detection, reaction and recovery. Reaction times count from the first tick with the fault.
Every end of a run commands zero force. The tests in the last column inject each fault; `softfinger run --inject`
[injects faults](../operate/faults.md) of a device. An error that ends a run is the cause of the event `state
faulted`. [Safety](../safety.md#crashes-that-cannot-be-handled) lists faults that cannot be detected."""
    results = json.loads(RESULTS_FILE.read_text("utf-8"))
    rows = [
        [
            hazard.name,
            hazard.detection,
            hazard.state if hazard.reaction == "none" else f"{hazard.reaction}: {hazard.state}",
            hazard.recovery,
            ", ".join(f"`{event}`" for event in hazard.events) or "none",
            _format_cases(hazard, results),
        ]
        for hazard in HAZARDS
    ]
    table = schema.format_grid(
        ["hazard", "detection", "reaction: safe state", "recovery", "event", "cases passed"], rows
    )
    about = """\
Results of the test run (`make faults-seen`). Ticks at 1 kHz, from the first tick with the fault until the
emulated device had received zero, including times that the guard waits, such as `frozen_s` (0.1 s in the tests);
and the state of the run."""
    columns = ["hazard", "injected", "ticks until zero", "event", "state", "recovery"]
    return _make_page(
        head, table, "## Injected faults and results", about, schema.format_grid(columns, _list_injected_rows(results))
    )


def _list_injected_rows(results: list[dict[str, Any]]) -> list[list[str]]:
    """Return a row for each injected fault, with all its drivers."""
    faults: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for result in results:
        if "driver" in result:
            key = tuple(result[name] for name in ("hazard", "fault", "event", "state", "recovery"))
            faults.setdefault(key, []).append(result)
    rows = []
    for (hazard, fault, event, state, recovery), of_fault in faults.items():
        after: dict[int | None, list[str]] = {}
        for result in of_fault:
            after.setdefault(result["ticks"], []).append(result["driver"])
        ticks = "; ".join(
            f"{'keeps a force' if count is None else count}: {', '.join(drivers)}"
            for count, drivers in sorted(after.items(), key=lambda item: item[0] or 0)
        )
        back = [result["back"] for result in of_fault if result.get("back") is not None]
        remaining = f": half of the force after {min(back)} to {max(back)} ticks" if back else ""
        reaction = event if event == "none" else f"`{event}`"
        rows.append([hazard, fault, ticks, reaction, state, recovery + remaining])
    return rows


def _format_cases(hazard: Hazard, results: list[dict[str, Any]]) -> str:
    """Format the number of passed cases of each test of a hazard, with a link to the test."""
    by_test = {result["test"]: result for result in results if result["hazard"] == hazard.name and "test" in result}
    words = []
    for test in hazard.tests:
        file, _, name = test.partition("::")
        counted = f"{by_test[test]['passed']} of {by_test[test]['of']}: " if test in by_test else ""
        words.append(f"{counted}[{name}](../../{file})")
    return ", ".join(words)


def make_materials_page() -> str:
    """Return the page of the library of materials and fingertips, with its sources."""
    head = """\
# Materials and fingertips: every entry

Names that a scene can use: `material = "rubber"`, `fingertip = "human-index"`. [Materials](../model/materials.md)
compares the models with published measurements; `softfinger materials NAME` prints one, with `--plot` its figure."""
    listed = library_texts.load_entries()
    parts = []
    for kind, title in (("material", "## Materials"), ("fingertip", "## Fingertips")):
        rows = [
            [
                f"`{name}`",
                f"{entry.about} {'Friction: ' + entry.friction_of + '.' if entry.friction_of else ''}".strip(),
                "<br>".join(f"`{key}` {value:g}" for key, value in flatten_entry(entry.values)),
                entry.holds,
                "<br>".join(map(library_texts.format_measured, entry.measured)),
                ", ".join(entry.papers),
            ]
            for name, (entry_kind, entry) in listed.items()
            if entry_kind == kind
        ]
        parts += [title, schema.format_grid(["name", "what", "values", "holds", "published", "sources"], rows)]
    by_read: dict[str, list[str]] = {}
    for name, paper in load_papers().items():
        by_read.setdefault(paper.read, []).append(name)
    *few, most = sorted(by_read, key=lambda read: len(by_read[read]))
    readers = "; ".join(f"of {', '.join(by_read[read])} {read}" for read in few)
    sources = [
        [name, paper.text + (f", doi `{paper.doi}`" if paper.doi else "")] for name, paper in load_papers().items()
    ]
    read = f"Of each source the {most} was read, but {readers}."
    return _make_page(head, *parts, "## Sources", read, schema.format_grid(["name", "source"], sources))


PAGES: Final[Mapping[str, Callable[[], str]]] = {
    "scenes.md": make_scenes_page,
    "rigs.md": make_rigs_page,
    "drivers.md": make_drivers_page,
    "experiments.md": make_experiments_page,
    "record.md": make_record_page,
    "telemetry.md": make_telemetry_page,
    "commands.md": make_commands_page,
    "states.md": make_states_page,
    "faults.md": make_faults_page,
    "materials.md": make_materials_page,
}


def format_keys_table(keys: Iterable[Key]) -> str:
    rows = [[f"`{key.name}`", _format_type(key), key.meaning] for key in keys if key is not protocol.SCHEMA_KEY]
    return schema.format_grid(["key", "type", "meaning"], rows)


def _format_type(key: Key) -> str:
    """Return type, unit and frame of a key, omitting missing ones: `float[3], m, world`."""
    return ", ".join(part for part in (key.type, key.unit, key.frame) if part not in ("", "1"))


def _describe_type(kind: Any) -> str:
    """Return the docstring of a type of the table of commands, on one line."""
    text = commands.VALUES if kind is commands.Values else kind.__doc__ if isinstance(kind, type) else ""
    return " ".join((text or "").split())


def _format_kind(field: Field) -> str:
    return f"{field.kind}[{field.size}]" if field.size > 1 else field.kind


def _format_numbers(values: Iterable[tuple[int, str]]) -> str:
    return ", ".join(f"{value} `{name}`" for value, name in values)


def _format_list(verb: str) -> str:
    rows = [[f"`{item['name']}`", item["description"]] for item in shipped.describe_shipped(verb)]
    return schema.format_grid(["name", "what it is"], rows)


def _make_page(head: str, *parts: str) -> str:
    title, _, text = head.partition("\n\n")
    text = textwrap.fill(" ".join(text.split()), WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n\n".join([title, GENERATED_NOTE, text, *parts]) + "\n"


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="reference", description=__doc__)
    parser.add_argument("folder", type=Path, help="where the pages go")
    folder = parser.parse_args(argv).folder
    for name, make_page in PAGES.items():
        (folder / name).write_text(make_page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
