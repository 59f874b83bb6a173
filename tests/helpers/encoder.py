"""Python encoder of tick messages, key by key from the record's table: the reference for the publisher's messages."""

import numpy as np

from softfinger.proxy.record import AT, FIELDS, PATCHES
from softfinger.server.wire.protocol import SCHEMA

_INT_COLUMNS = [f.at for f in FIELDS if f.kind == "int"]


def _contact_map(values, every):
    top = {"schema": SCHEMA, "every": every}
    for field in FIELDS:
        parent, _, key = field.name.rpartition(".")
        value = values[field.at] if field.size == 1 else values[field.at : field.at + field.size]
        (top.setdefault(parent, {}) if parent else top)[key] = int(value) if field.kind == "int" else value
    patches = [top.pop(f"contacts{i}") for i in range(PATCHES)]
    return top | {"contacts": [patch for patch in patches if patch["object"] >= 0]}


def contact_map(record, every=1):
    usable = record.copy()
    # a nan or inf in an integer field (buttons of a device) becomes 0
    usable[_INT_COLUMNS] = np.nan_to_num(record[_INT_COLUMNS], nan=0.0, posinf=0.0, neginf=0.0)
    return _contact_map(usable.tolist(), every)


def state_map(record, scene, epoch_s=0.0):
    row = record.tolist()
    return {
        "timestamp": row[AT.timestamp] - epoch_s,
        "sequence": int(row[AT.tick]),
        "position": row[AT.probe_position : AT.probe_position + 3],
        "velocity": row[AT.probe_velocity : AT.probe_velocity + 3],
        "force": row[AT.force : AT.force + 3],
        "active_field": scene,
        "field_state": {
            "mode": int(row[AT.contact_mode]),
            "object": int(row[AT.contact_object]),
            "penetration": row[AT.contact_penetration],
        },
    }
