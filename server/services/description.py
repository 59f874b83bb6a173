"""Description of a daemon for the command `describe` and for its recordings."""

from __future__ import annotations

import platform
from typing import Any

import llvmlite.binding as llvm
import msgspec

from softfinger.config.load import describe
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR, KERNEL_FOLDER
from softfinger.proxy.kernels.jit.source_hash import SOURCE_HASH
from softfinger.proxy.scene import explain
from softfinger.server.loop.clock import NS_PER_S
from softfinger.server.recording.writer import list_package_versions
from softfinger.server.services.rendering import Rendering


def describe_daemon(rendering: Rendering, scene_name: str) -> dict[str, Any]:
    """Return the answer to `describe` without the wire schema; plain values."""
    servo, scene, faults = rendering.servo, rendering.scene, rendering.faults
    return {
        "rig": describe(rendering.rig),
        "scene": describe(scene),
        "scene_name": scene_name,
        "since": rendering.since,
        "since_missed": servo.missed_before,
        "fingers": [
            {
                "name": finger.name,
                "device": msgspec.to_builtins(device.info),
                "offset_m": offset,
                "led": device.hand() is not None,
            }
            for finger, device, offset in zip(scene.fingers, servo.devices, rendering.offsets, strict=True)
        ],
        "device": msgspec.to_builtins(servo.devices[0].info),
        "rate_hz": NS_PER_S / servo.period_ns,
        "armed": rendering.force.is_requested,
        "state": rendering.force.state,
        "ticks": servo.ticks,
        "versions": list_package_versions(),
        "machine": {"system": platform.platform(), "cpu": llvm.get_host_cpu_name()},
        "compiled": {
            "model": explain(scene),
            "source": SOURCE_HASH,
            "cache": str(CACHE_DIR),
            "not_kept": KERNEL_FOLDER.problem() or "",
        },
    } | ({} if faults is None else {"faults": describe(faults)["fault"]})
