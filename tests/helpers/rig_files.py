"""Rigs of tests, from shipped rigs."""

import copy
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softfinger.config.load import build, load_rig
from softfinger.config.schema import Rig
from softfinger.config.sources import find
from softfinger.drivers import registry


def load_rig_in_process(name: str, device: Mapping[str, Any], overrides: Mapping[str, Any] | None = None) -> Rig:
    """Return a rig with changed keys of [device], without real time, whose force is full after 10 ms."""
    base = {"servo.realtime": "off", "guard.ramp_s": 0.01, "telemetry.endpoint": "tcp://127.0.0.1:*"}
    return load_rig(name, base | {f"device.{key}": value for key, value in device.items()} | dict(overrides or {}))


def rig_options(rig: str, **changes: Any) -> Any:
    """Return the options of a shipped rig's driver with changed keys of [device]."""
    device = load_rig(rig).device
    return build(registry.load(device.driver).Options, {**device.options, **changes}, f"{rig} [device]")


def with_key(options: Mapping[str, Any], path: str, value: Any) -> dict[str, Any]:
    """Return a copy of the options with another value of the key at a path such as `frames.input.field.0.type`.

    None removes the key.
    """
    copied = copy.deepcopy(dict(options))
    *tables, last = path.split(".")
    at: Any = copied
    for key in tables:
        at = at[int(key)] if key.isdigit() else at[key]
    if value is None:
        del at[last]
    else:
        at[last] = value
    return copied


def write_rig(folder: Path, name: str, **keys: object) -> Path:
    """Write a shipped rig with changed keys of [device] to a new file in `folder`."""
    text = find(name, Rig).read_text()
    for key in keys:
        text = re.sub(rf"^{key} = .*\n", "", text, flags=re.MULTILINE)
    lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
    path = folder / f"my-{name}-{len(list(folder.iterdir()))}.toml"
    path.write_text(text.replace("[device]\n", f"[device]\n{lines}"))
    return path
