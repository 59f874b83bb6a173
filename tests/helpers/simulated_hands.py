"""Move the hands of a shipped rig on the bodies of its scene, tick by tick, without a clock."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from softfinger.config.load import build, load_rig, load_scene
from softfinger.config.schema.pairing import pair_devices
from softfinger.drivers.simulated.options import Options, make_simulation
from softfinger.drivers.simulated.plant import DELAY_LINE_SIZE, PlantInputs
from softfinger.proxy.bodies import begin_bodies
from softfinger.proxy.record import RECORD_SIZE
from softfinger.proxy.records import Records
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.closed_loop import ClosedLoop, DrivenPlant

DT = 1e-3


class SimulatedHands:
    """Simulation of `softfinger run --scene NAME` until a time.

    name         a shipped scene; its rig plays `instead`, what `load_scene` takes, if given
    model, data  MuJoCo's own
    """

    def __init__(self, name: str, instead: Mapping[str, Any] | None = None) -> None:
        scene, rig = load_scene(instead or name), load_rig(f"simulated-{name}")
        tuning = make_tuning(scene, rig.guard)
        owner = tuning.scene.bodies.block.owner
        self.model, self.data = owner.model, owner.data
        pairs = pair_devices(scene, rig)
        devices = [make_simulation(build(Options, entry.device.options, entry.table), 1.0 / DT) for entry in pairs]
        self._names = [entry.finger for entry in pairs]
        self._hands = tuple(
            DrivenPlant(device.plant, PlantInputs(device.intention, device.poses, np.zeros(DELAY_LINE_SIZE)))
            for device in devices
        )
        self._loop = ClosedLoop(tuning, [device.state for device in devices])
        self._ticks = 0
        begin_bodies(tuning.scene, DT)

    def until(self, seconds: float) -> dict[str, Records]:
        """Return the records of each finger, by name, from the present tick until this time since the start."""
        records = np.zeros((round(seconds / DT) - self._ticks, len(self._hands), RECORD_SIZE))
        self._loop.run(self._hands, DT, self._ticks, records)
        self._ticks += len(records)
        return {name: Records(np.ascontiguousarray(records[:, at])) for at, name in enumerate(self._names)}
