"""What can go wrong, and what is done about it."""

from __future__ import annotations

from typing import Final

ADVICE: Final = {
    "not_finite": "the scene gave no finite force: softfinger check names values that do not go together",
    "pose_refused": "the device gave no usable pose: see to its sensors and its cable",
    "pose_jumped": "the pose jumped, farther than a hand comes: see to sensors and cable; if it was a hand, raise "
    "guard.speed_max_m_per_s",
    "pose_frozen": "the pose repeats bit for bit under a force: move the handle; if it rests, disarm",
    "too_fast": "the handle was faster than guard.handle_speed_max_m_per_s: hold it, and arm if the rig asks for that; "
    "if nobody moved it so, take a softer scene, or turn to the sign of the force",
    "motor_hot": "the force is lowered until the motors have cooled: let go for a while, or take a softer scene",
    "energy_spent": "the rendering gave the hand more than guard.energy_max_j, and its force fades: take a softer "
    "scene or [passivity]; for an object that is meant to push, raise that limit",
    "workspace_edge": "the handle is at the edge of guard.workspace: come back from it",
}
"""What to do, by the name of a guard's event; those not here need nothing."""
