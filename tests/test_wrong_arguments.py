"""Arguments of wrong types at every entry of the Python interface raise one error, which names the argument."""

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from softfinger import Client, Engine, Experiment, HapticError, load_scene, run_recording
from softfinger.config.load import load_faults, load_rig
from softfinger.server.keys import client_keys
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.control import AsyncControl, Control

pytestmark = pytest.mark.plain

POSITION, ORIENTATION = [0.0, 0.0, 0.0095], [1.0, 0.0, 0.0, 0.0]
STIFFNESS = "object.table.material.stiffness_n_per_m"
WRONG = [object(), 1j, b"bytes", [object()], {object(): 1}, object, len, {3: {}}]
"""Values that no argument accepts; arguments that accept a mapping refuse its keys."""


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("ends")
    endpoints = f"ipc://{folder}/t", f"ipc://{folder}/c"
    with closing(Client(*endpoints, timeout_s=0.01)) as client:
        yield SimpleNamespace(
            engine=Engine("paper-plane"), experiment=Experiment("stiffness-discrimination"), client=client,
            endpoints=endpoints, samples=client.subscribe("event"), window=client.window(),
        )  # fmt: skip


ENTRIES: dict[str, tuple[str, Callable[[Any, Any], Any]]] = {
    "Engine(x)": ("scene", lambda given, x: Engine(x)),
    "Engine(rate_hz=x)": ("rate_hz", lambda given, x: Engine("paper-plane", rate_hz=x)),
    "step(x, orientation)": ("position", lambda given, x: given.engine.step(x, ORIENTATION)),
    "step(position, x)": ("orientation", lambda given, x: given.engine.step(POSITION, x)),
    "step(dt=x)": ("dt", lambda given, x: given.engine.step(POSITION, ORIENTATION, dt=x)),
    "run(x)": ("poses", lambda given, x: given.engine.run(x)),
    "run({finger: x})": ("poses", lambda given, x: given.engine.run({"": x})),
    "run(dt=x)": ("dt", lambda given, x: given.engine.run([[*POSITION, *ORIENTATION]], dt=x)),
    "set(x)": ("set", lambda given, x: given.engine.set(x)),
    "set(path, x)": ("material.stiffness_n_per_m", lambda given, x: given.engine.set(STIFFNESS, x)),
    "get(x)": ("path", lambda given, x: given.engine.get(x)),
    "tune(x)": ("scene", lambda given, x: given.engine.tune(x)),
    "load_scene(x)": ("scene", lambda given, x: load_scene(x)),
    "load_scene(overrides=x)": ("overrides", lambda given, x: load_scene("sphere", x)),
    "load_scene(sources=x)": ("sources", lambda given, x: load_scene("sphere", {STIFFNESS: -1.0}, x)),
    "load_rig(x)": ("rig", lambda given, x: load_rig(x)),
    "load_rig(overrides=x)": ("overrides", lambda given, x: load_rig("replay", x)),
    "load_faults(x)": ("faults", lambda given, x: load_faults(x)),
    "run_recording(x)": ("recording|poses of", lambda given, x: run_recording(x)),
    "run_recording({finger: x})": ("recording", lambda given, x: run_recording({"": x})),
    "run_recording(scene=x)": ("scene", lambda given, x: run_recording("tap", x)),
    "run_recording(overrides=x)": ("overrides", lambda given, x: run_recording("tap", overrides=x)),
    "run_recording(rig=x)": ("rig", lambda given, x: run_recording("tap", rig=x)),
    "run_recording(rate_hz=x)": ("servo.rate_hz", lambda given, x: run_recording("tap", rate_hz=x)),
    "Experiment(x)": ("experiment", lambda given, x: Experiment(x)),
    "Experiment(changes=x)": ("changes", lambda given, x: Experiment("stiffness-discrimination", x)),
    "rehearse(x)": ("participant", lambda given, x: given.experiment.rehearse(x)),
    "Experiment.run(x, 1)": ("folder", lambda given, x: given.experiment.run(x, 1)),
    "Experiment.run(folder, x)": ("participant", lambda given, x: given.experiment.run(Path("none"), x)),
    "Client(x)": ("telemetry", lambda given, x: Client(x)),
    "Client(commands=x)": ("endpoint", lambda given, x: Client(given.endpoints[0], x)),
    "Client(timeout_s=x)": ("timeout_s", lambda given, x: Client(*given.endpoints, timeout_s=x)),
    "ask(x)": ("method", lambda given, x: given.client.ask(x)),
    "set_scene(x)": ("scene", lambda given, x: given.client.set_scene(x)),
    "set_scene(overrides=x)": ("overrides", lambda given, x: given.client.set_scene("sphere", x)),
    "mark(data=x)": ("data", lambda given, x: given.client.mark("a", x)),
    "subscribe(x)": ("topics", lambda given, x: given.client.subscribe(x)),
    "receive(x)": ("timeout_s", lambda given, x: given.samples.receive(x)),
    "window(x)": ("samples", lambda given, x: given.client.window(x)),
    "window(finger=x)": ("finger", lambda given, x: given.client.window(finger=x)),
    "client_keys(x)": ("no key can be read", lambda given, x: client_keys(x, x)),
    "Control(keys=x)": ("keys", lambda given, x: Control(given.endpoints[1], keys=x)),
    "AsyncControl(x)": ("endpoint", lambda given, x: AsyncControl(x)),
    "subscribe(keys=x)": ("keys", lambda given, x: subscribe(given.endpoints[0], "event", keys=x)),
    "update(x)": ("timeout_s", lambda given, x: given.window.update(x)),
}
"""Name of the argument in the message, and a call with a value of it."""


@pytest.mark.parametrize("entry", ENTRIES)
def test_an_argument_of_a_wrong_type_is_named(entry: str, given: Any) -> None:
    name, call = ENTRIES[entry]
    for value in WRONG:
        with pytest.raises(HapticError, match=name):
            call(given, value)
