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
RAMP_S: Final = Range(0.01, 10.0, "a shorter ramp is a step; above 10 s the device seems to be off")
SPEED_MAX_M_PER_S: Final = Range(0.1, 1e3, "a lower limit stops normal motion; a higher one detects no jump")
TURN_MAX_RAD_PER_S: Final = Range(1.0, 1e4, "a lower limit stops normal motion; a higher one detects no jump")
FROZEN_S: Final = Range(0.0, 60.0, "0: no limit; above a minute the limit has no use")
HANDLE_SPEED_MAX_M_PER_S: Final = Range(0.1, 1e3, "a lower limit stops normal motion; a higher one has no effect")
CONTINUOUS_FORCE_N: Final = Range(0.1, 40.0, "a smaller force is not perceptible; the guard allows no larger one")
HEAT_TIME_S: Final = Range(0.1, 3600.0, "motors heat up within seconds to minutes")
ENERGY_MAX_J: Final = Range(1e-3, 1e3, "a spring of 1000 N/m at 12 N stores 0.07 J; a limit above 1000 J has no effect")
WORKSPACE_SIZE_M: Final = Range(1e-3, 10.0, "from a millimetre to more than any desktop device")
WALL_STIFFNESS_N_PER_M: Final = Range(
    1.0, 2000.0, "a softer wall is not perceptible; a stiffer one is not a soft limit"
)

# Servo loop.
RATE_HZ: Final = Range(100.0, 8_000.0, "slower loops make walls chatter; faster ones exceed the frame rate of USB")
PRIORITY: Final = Range(1, 99, "the priorities of SCHED_FIFO")
CPU: Final = Range(0, 1023, "the size of the kernel's processor mask")
EVERY: Final = Range(1, 10_000, "one message per 10 000 ticks is one per 10 s at 1 kHz")

# Contents of a scene, and communication.
TOOL_M: Final = Range(-1.0, 1.0, "a longer tool gives torques that no grip resists")
LENGTH_M: Final = Range(1e-5, 1e3, "the contact model is tested between these")
FINGERTIP_ASPECT: Final = Range(1.0, 10.0, "a fingertip has about 2; higher ratios are discs or needles")
COORDINATE_M: Final = Range(-1e3, 1e3, "float64 resolves 1e-13 m there, and no device reaches farther")
QUATERNION: Final = Range(-1e3, 1e3, "only the direction of a quaternion counts; it is normalised")
STIFFNESS_N_PER_M: Final = Range(1e-3, 1e6, "the contact model is tested between these")
DAMPING_NS_PER_M: Final = Range(0.0, 1e4, "damping above the friction of the device makes a sampled wall active")
NORMAL_EXPONENT: Final = Range(
    1.0, 3.0, "below 1 the initial stiffness is infinite; above 3 contact is hardly perceptible"
)
NORMAL_DEPTH_M: Final = Range(1e-5, 1.0, "from the step of an encoder to more than any fingertip penetrates")
NORMAL_DAMPING_S_PER_M: Final = Range(0.0, 100.0, "at 100 the force of a touch at 1 cm/s is doubled")
FRICTION: Final = Range(0.0, 1e3, "above 1000 nothing slides")
FRICTION_SCALE: Final = Range(1e-3, 1e3, "real surfaces have smaller ratios")
STRIBECK_SPEED_M_PER_S: Final = Range(1e-5, 10.0, "from imperceptible motion to the fastest hand")
VISCOUS_S_PER_M: Final = Range(0.0, 100.0, "at 100 a slip of 1 cm/s adds 1 to the coefficient of friction")
TORSION_EXPONENT: Final = Range(0.0, 1.0 / 3.0, "0 is a patch of fixed size, 1/3 that of an elastic sphere (Hertz)")
TORSION_NM_PER_RAD: Final = Range(1e-6, 100.0, "a fingertip has about 0.05; 100 is a clamped shaft")
TORSIONAL_DAMPING_NMS_PER_RAD: Final = Range(0.0, 1.0, "above 1 a rotation of the wrist is blocked")
FRICTION_LENGTH_M: Final = Range(0.0, 1.0, "it is about two thirds of the radius of the contact patch")
SHEAR_MODULUS_PA: Final = Range(1e2, 1e12, "jelly has 100 Pa, diamond 0.5 TPa")
PATCH_RADIUS_M: Final = Range(1e-5, 0.1, "a fingertip pressed with 1 N has a few millimetres")
PRESSURE_EXPONENT: Final = Range(1.0, 100.0, "1 is a conical pressure, 100 an almost uniform one")
ROLLING_LOSS: Final = Range(0.0, 1.0, "1 dissipates all of the energy")
TIME_CONSTANT_S: Final = Range(0.0, 0.1, "slower velocity filters lag and add energy")
RESOLUTION_M: Final = Range(0.0, 1e-3, "a device with coarser steps cannot render a contact")
ROLL_TOLERANCE: Final = Range(1e-13, 1e-3, "smaller errors are rounding; for larger ones a simple method suffices")
EFFECT_FORCE_N: Final = Range(0.0, 40.0, "the guard allows no larger force")
FREQUENCY_HZ: Final = Range(0.0, 500.0, "half of the usual 1 kHz; faster sines alias")
MOTION_FREQUENCY_HZ: Final = Range(0.0, 100.0, "ten ticks per cycle at 1 kHz; faster objects jump between ticks")
EXPONENT: Final = Range(
    1.0, 8.0, "below 1 the attraction starts with a step; above 8 it is perceptible only at the surface"
)
ANGLE_RAD: Final = Range(-3.141592653589793, 3.141592653589793, "half a turn in each direction covers all angles")
TURN_RATE_RAD_PER_S: Final = Range(-100.0, 100.0, "a tenth of a radian per tick at 1 kHz")
EDGE_M: Final = Range(0.0, 1.0, "a softer edge is not perceptible")
TEXTURE_HEIGHT_M: Final = Range(1e-7, 0.01, "0.1 um is imperceptible; above 1 cm it is a shape, not a texture")
HEIGHT_PITCH_M: Final = Range(1e-6, 10.0, "no device resolves less than 1 um or reaches 10 m")
HEIGHT_LEVEL_M: Final = Range(
    1e-12, 1e3, "65536 levels of 1 pm are imperceptible; levels above 1 km exceed every coordinate"
)
STROKE_M_PER_S: Final = Range(1e-3, 10.0, "from imperceptible motion to the fastest hand")
GRID_VALUES: Final = Range(2, 1 << 20, "1024 by 1024, of 8 MB")
YOUNGS_PA: Final = Range(1e2, 1e15, "jelly has 100 Pa, diamond 1 TPa; beyond that a body is rigid")
ELASTIC_POISSON: Final = Range(0.0, 0.495, "at 0.5 a body is incompressible, and its stiffness matrix has no inverse")
ELASTIC_EDGE_M: Final = Range(1e-5, 1.0, "the finest possible mesh has 2,500 compliant vertices")
DENSITY_KG_PER_M3: Final = Range(1.0, 3e4, "foam has 20, osmium 22,600")
ELASTIC_DAMPING_S: Final = Range(0.0, 10.0, "foam with memory takes seconds to recover")
ELASTIC_NODES: Final = Range(1, 2500, "their compliance takes 450 MB")
ELASTIC_TETRAHEDRA: Final = Range(1, 100_000, "their factorisation takes minutes")
MESH_SCALE: Final = Range(1e-9, 1e9, "from nanometres to millions of kilometres")
MESH_SIZE_M: Final = Range(1e-6, 1e3, "the contact model is tested between these")
MESH_TRIANGLES: Final = Range(1, 20_000_000, "they take 2.5 GB of memory")
MESH_BYTES: Final = Range(1, 1 << 31, "20 million triangles have 1 GB as binary STL, and less as PLY or OBJ")
SUBSTEPS: Final = Range(1, 16, "each is one step; 16 at 1 kHz leave 60 us per step")
BODY_MASS_KG: Final = Range(1e-6, 1e4, "from a grain of sand to more than fingers can move")
STEP_BUDGET_US: Final = Range(1.0, 1e5, "a step of one body takes some microseconds; a tick of 10 Hz lasts 0.1 s")
GEOM_GROUP: Final = Range(0, 1000, "MuJoCo's groups are small numbers from 0")
GEOM_MATERIALS: Final = Range(0, 256, "the largest number of objects")
FILE_NAME_LENGTH: Final = Range(1, 4096, "the limit of Linux")
EFFECTS: Final = Range(0, 16, "every effect is compiled into the contact step")
FINGERS: Final = Range(0, 5, "a hand has five, and every finger is compiled into the tick")
OBJECTS: Final = Range(1, 256, "every object is examined in every tick")
TOPIC_PART_LENGTH: Final = Range(1, 32, "a telemetry topic is short")
NAME_LENGTH: Final = Range(1, 64, "a name must fit on one line of a report")
PARAMETER_RAMP_S: Final = Range(0.0, 10.0, "0: immediate; changes over more than 10 s go unnoticed")
HEARTBEAT_S: Final = Range(0.05, 60.0, "a shorter time disconnects busy clients; no client waits longer")
ENDPOINT_LENGTH: Final = Range(1, 256, "longer than any address of ZeroMQ")

# Simulated device.
MASS_KG: Final = Range(1e-3, 100.0, "from lighter than a knob to heavier than any handle")
HAND_MASS_KG: Final = Range(0.0, 10.0, "0: no hand; an arm has less than 10 kg")
DEVICE_FRICTION_N: Final = Range(0.0, 40.0, "the strongest desktop devices cannot overcome more")
LAG_S: Final = Range(0.0, 0.1, "slower amplifiers cannot render contact")
DELAY_TICKS: Final = Range(0, 16, "capacity of a chain of buffers; size of the ring buffer of queued forces")

# Injected faults.
FAULTS: Final = Range(1, 256, "each is checked in every tick")
FAULT_TICK: Final = Range(0, 100_000_000, "a day at 1 kHz")
FAULT_TIME_S: Final = Range(0.0, 100_000.0, "a day")
FAULT_EVERY: Final = Range(1, 100_000, "use a single fault instead of a rarer one")
FAULT_BLOCK_S: Final = Range(0.0, 60.0, "a call that takes a minute does not return")
FAULT_NUMBERS: Final = Range(0, 9, "a sample has ten numbers, and ten are complete")
FAULT_SEED: Final = Range(1, 1_000_000_000, "a positive integer")
FAULT_BUTTONS: Final = Range(1, (1 << 32) - 1, "devices have up to 32 buttons")
