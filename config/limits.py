"""Hard limits of all configuration values, each with its reason.

No file and no command-line flag can widen them. A rig may lower the limits of a device but cannot raise them past
these. The limits of the device itself, known once it is open, apply in addition.
"""

from __future__ import annotations

from typing import Final, NamedTuple


class Range(NamedTuple):
    """Closed interval [low, high] in the unit of the key that uses it, with the reason for its ends."""

    low: float
    high: float
    reason: str


# Guard: force at the hand and motion of the device.
FORCE_MAX_N: Final = Range(0.0, 40.0, "the strongest desktop devices display 37 N; more can hurt a finger")
TORQUE_MAX_NM: Final = Range(0.0, 2.0, "twice the torque that a fingertip grip resists")
FORCE_SLEW_N_PER_S: Final = Range(1.0, 20_000.0, "zero to the highest force in 2 ms; faster is a blow, not a contact")
TORQUE_SLEW_NM_PER_S: Final = Range(0.01, 1_000.0, "zero to the highest torque in 2 ms")
RAMP_S: Final = Range(0.01, 10.0, "a ramp of a few ticks is none; past 10 s an engaged device seems dead")
SPEED_MAX_M_PER_S: Final = Range(0.1, 1e3, "slower is a stroke of every day; past 1000 nothing is a jump")
TURN_MAX_RAD_PER_S: Final = Range(1.0, 1e4, "slower is a turn of every day; past 10 000 nothing is a jump")
FROZEN_S: Final = Range(0.0, 60.0, "0: no limit; above a minute the limit has no use")
HANDLE_SPEED_MAX_M_PER_S: Final = Range(0.1, 1e3, "slower is a stroke of every day; past 1000 nothing is fast")
CONTINUOUS_FORCE_N: Final = Range(0.1, 40.0, "less is no force; no more than the guard may let through")
HEAT_TIME_S: Final = Range(0.1, 3600.0, "faster is a fuse; above an hour the device itself warms up")
ENERGY_MAX_J: Final = Range(
    1e-3, 1e3, "a spring of 1000 N/m at 12 N stores 0.07 J; above 1000 J there is no limit in effect"
)
WORKSPACE_SIZE_M: Final = Range(1e-3, 10.0, "less is no workspace; no desk has more than 10 m")
WALL_STIFFNESS_N_PER_M: Final = Range(1.0, 2000.0, "less is not felt; more is no soft wall")

# Servo loop.
RATE_HZ: Final = Range(100.0, 8_000.0, "below, walls chatter; above, there is no USB frame short enough")
PRIORITY: Final = Range(1, 99, "the priorities of SCHED_FIFO")
CPU: Final = Range(0, 1023, "the size of the kernel's processor mask")
EVERY: Final = Range(1, 10_000, "one message in every 10 000 ticks is 10 s of silence at 1 kHz")

# Contents of a scene, and communication.
TOOL_M: Final = Range(-1.0, 1.0, "a tool of more than a metre is no stylus, and its torque none for a grip")
LENGTH_M: Final = Range(1e-5, 1e3, "the contact model is tested between these")
FINGERTIP_ASPECT: Final = Range(1.0, 10.0, "a fingertip has about 2; a disc or a needle has edges where it bends")
COORDINATE_M: Final = Range(-1e3, 1e3, "farther out float64 still resolves 1e-13 m, but no device reaches it")
QUATERNION: Final = Range(-1e3, 1e3, "only the direction of a quaternion counts; it is normalised")
STIFFNESS_N_PER_M: Final = Range(1e-3, 1e6, "the contact model is tested between these")
DAMPING_NS_PER_M: Final = Range(0.0, 1e4, "damping above the friction of the device makes a sampled wall active")
NORMAL_EXPONENT: Final = Range(1.0, 3.0, "below 1 a touch is endlessly stiff; past 3 it is hardly felt")
NORMAL_DEPTH_M: Final = Range(
    1e-5, 1.0, "a hundredth of a millimetre is an encoder's step, and no finger sinks in by 1 m"
)
NORMAL_DAMPING_S_PER_M: Final = Range(0.0, 100.0, "at 100 a touch at 1 cm/s is already felt twice as hard")
FRICTION: Final = Range(0.0, 1e3, "past 1000 nothing ever slides")
FRICTION_SCALE: Final = Range(1e-3, 1e3, "no surface is a thousand times rougher in one direction than in the other")
STRIBECK_SPEED_M_PER_S: Final = Range(1e-5, 10.0, "slower is no motion, faster no hand")
VISCOUS_S_PER_M: Final = Range(0.0, 100.0, "at 100 a slip of 1 cm/s already has the friction of a coefficient of 1")
TORSION_EXPONENT: Final = Range(0.0, 1.0 / 3.0, "0 is a patch of fixed size, 1/3 that of an elastic sphere (Hertz)")
TORSION_NM_PER_RAD: Final = Range(1e-6, 100.0, "a fingertip has about 0.05; 100 is a clamped shaft")
TORSIONAL_DAMPING_NMS_PER_RAD: Final = Range(0.0, 1.0, "above 1 a rotation of the wrist is blocked")
FRICTION_LENGTH_M: Final = Range(0.0, 1.0, "it is about two thirds of the radius of the contact patch")
SHEAR_MODULUS_PA: Final = Range(1e2, 1e12, "jelly has 100 Pa, diamond 0.5 TPa")
PATCH_RADIUS_M: Final = Range(1e-5, 0.1, "a fingertip pressed with 1 N has a few millimetres")
PRESSURE_EXPONENT: Final = Range(1.0, 100.0, "1 is a pressure like a cone's, 100 all but even")
ROLLING_LOSS: Final = Range(0.0, 1.0, "no more can be lost than was put in")
TIME_CONSTANT_S: Final = Range(0.0, 0.1, "a slower velocity filter lags behind the hand and feeds energy in")
RESOLUTION_M: Final = Range(0.0, 1e-3, "a device with coarser steps cannot render a contact")
ROLL_TOLERANCE: Final = Range(1e-13, 1e-3, "below is rounding; above, a plain method is as good")
EFFECT_FORCE_N: Final = Range(0.0, 40.0, "no more than the guard may let through")
FREQUENCY_HZ: Final = Range(0.0, 500.0, "half of the usual 1 kHz; a faster sine would come out as a slower one")
MOTION_FREQUENCY_HZ: Final = Range(0.0, 100.0, "ten ticks a cycle at 1 kHz; a faster object jumps between ticks")
EXPONENT: Final = Range(1.0, 8.0, "below 1 the pull starts with a step; past 8 it is felt at the surface only")
ANGLE_RAD: Final = Range(-3.141592653589793, 3.141592653589793, "half a turn to either side covers all directions")
TURN_RATE_RAD_PER_S: Final = Range(-100.0, 100.0, "a tenth of a radian a tick at 1 kHz")
EDGE_M: Final = Range(0.0, 1.0, "a softer edge than that is no edge")
TEXTURE_HEIGHT_M: Final = Range(1e-7, 0.01, "0.1 um is less than a fingertip feels; higher than 1 cm is a shape")
HEIGHT_PITCH_M: Final = Range(1e-6, 10.0, "finer than 1 um no device resolves; 10 m is farther than one reaches")
HEIGHT_LEVEL_M: Final = Range(1e-12, 1e3, "65536 levels of 1 pm are less than a finger feels; one of 1 km is the most")
STROKE_M_PER_S: Final = Range(1e-3, 10.0, "slower is no stroke, faster no hand")
GRID_VALUES: Final = Range(2, 1 << 20, "1024 by 1024, of 8 MB")
YOUNGS_PA: Final = Range(1e2, 1e15, "jelly has 100 Pa, diamond 1 TPa; beyond that a body is rigid")
ELASTIC_POISSON: Final = Range(0.0, 0.495, "at 0.5 a body is incompressible, and its stiffness matrix has no inverse")
ELASTIC_EDGE_M: Final = Range(1e-5, 1.0, "the finest mesh that can be built has 2,500 compliant vertices")
DENSITY_KG_PER_M3: Final = Range(1.0, 3e4, "foam has 20, osmium 22,600")
ELASTIC_DAMPING_S: Final = Range(0.0, 10.0, "foam with memory takes seconds to recover")
ELASTIC_NODES: Final = Range(1, 2500, "their compliance takes 450 MB")
ELASTIC_TETRAHEDRA: Final = Range(1, 100_000, "their factorisation takes minutes")
MESH_SCALE: Final = Range(1e-9, 1e9, "from nanometres to millions of kilometres")
MESH_SIZE_M: Final = Range(1e-6, 1e3, "the contact model is tested between these")
MESH_TRIANGLES: Final = Range(1, 20_000_000, "they take 2.5 GB as they are rendered")
MESH_BYTES: Final = Range(1, 1 << 31, "20 million triangles have 1 GB as binary STL, and less as PLY or OBJ")
SUBSTEPS: Final = Range(1, 16, "each costs one step; 16 at 1 kHz leave 60 us")
BODY_MASS_KG: Final = Range(1e-6, 1e4, "a grain of sand; more than any body that fingers move")
STEP_BUDGET_US: Final = Range(1.0, 1e5, "a step of one body takes some microseconds; a tick of 10 Hz lasts 0.1 s")
GEOM_GROUP: Final = Range(0, 1000, "MuJoCo's groups are small numbers from 0")
GEOM_MATERIALS: Final = Range(0, 256, "as many as there may be objects")
FILE_NAME_LENGTH: Final = Range(1, 4096, "Linux opens no longer name")
EFFECTS: Final = Range(0, 16, "every effect is compiled into the contact step")
FINGERS: Final = Range(0, 5, "a hand has five, and every finger is compiled into the tick")
OBJECTS: Final = Range(1, 256, "every kind is compiled, and every object is asked in every tick")
TOPIC_PART_LENGTH: Final = Range(1, 32, "a telemetry topic is short")
NAME_LENGTH: Final = Range(1, 64, "a name has to fit a line of a report")
PARAMETER_RAMP_S: Final = Range(0.0, 10.0, "0: at once; above 10 s a change is not noticed")
HEARTBEAT_S: Final = Range(0.05, 60.0, "below this a busy peer counts as dead; above it no client waits")
ENDPOINT_LENGTH: Final = Range(1, 256, "longer than any address ZeroMQ takes")

# Simulated device.
MASS_KG: Final = Range(1e-3, 100.0, "a handle of a gram is lighter than a knob, one of 100 kg is no handle")
HAND_MASS_KG: Final = Range(0.0, 10.0, "0: no hand; above 10 kg it is a person")
DEVICE_FRICTION_N: Final = Range(0.0, 40.0, "no more than the strongest desktop device could overcome")
LAG_S: Final = Range(0.0, 0.1, "amplifiers slower than a tenth of a second display no contact")
DELAY_TICKS: Final = Range(0, 16, "capacity of a chain of buffers; size of the ring buffer of queued forces")

# Injected faults.
FAULTS: Final = Range(1, 256, "each is looked at in every tick")
FAULT_TICK: Final = Range(0, 100_000_000, "a day at 1 kHz")
FAULT_TIME_S: Final = Range(0.0, 100_000.0, "a day")
FAULT_EVERY: Final = Range(1, 100_000, "a rarer one is a single fault")
FAULT_BLOCK_S: Final = Range(0.0, 60.0, "a call that takes a minute does not come back")
FAULT_NUMBERS: Final = Range(0, 9, "a sample has ten numbers, and a complete one is no fault")
FAULT_SEED: Final = Range(1, 1_000_000_000, "as many runs as anybody repeats")
FAULT_BUTTONS: Final = Range(1, (1 << 32) - 1, "devices have up to 32 buttons")
