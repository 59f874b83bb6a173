"""Boards whose numbers and mechanism a rig describes: conversion between packets and poses or forces.

The drivers `hid` and `serial` carry the packets. The fields here follow those of `board_exchange`.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, NamedTuple

from softfinger.drivers.base import SAMPLE_BUTTONS, SAMPLE_GRIPPER, DeviceInfo, make_info
from softfinger.drivers.block import Block, address, counter, lay_out, numbers, word
from softfinger.drivers.board_exchange import BOARD
from softfinger.drivers.fields.options import InputField, OutputField
from softfinger.drivers.fields.table import (
    BUTTONS,
    COMMANDED_SIZE,
    CONSTANT,
    GRIPPER,
    SENSED_SIZE,
    encode,
    make_input_table,
    make_output_table,
)
from softfinger.drivers.kinematics.mechanism import (
    FULL,
    INVALID,
    LIMITED,
    NO_MECHANISM,
    SINGULAR,
    Mechanism,
    compute_command,
    find_kind,
    forward_kinematics,
    make_mechanism,
)
from softfinger.drivers.kinematics.options import Kinematics
from softfinger.drivers.mounting import MountedOptions, Mounting
from softfinger.drivers.samples import is_zero, store_pose
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at
from softfinger.proxy.kernels.jit.pack import flatten, unpack_at
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import conjugate, multiply, normalize, rotate


class FrameConversion(NamedTuple):
    """Parameters of the conversion between packets and poses or forces.

    mechanism
    position     (3,) m  device's origin in the world
    orientation  (4,)    device to world
    """

    mechanism: Mechanism
    position: Vec3
    orientation: Quaternion


MODEL_LIKE: Final = FrameConversion(NO_MECHANISM, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
MODEL_SIZE: Final = len(flatten(MODEL_LIKE))


class Fields(NamedTuple):
    """Fields of a described board; the fields of the driver follow."""

    cut: Annotated[int, counter("forces above the limit")]
    singular: Annotated[
        int, counter("forces reduced and samples without a position because the mechanism was in a singular pose")
    ]
    kind: Annotated[int, word("kind of mechanism")]
    has_orientation: Annotated[int, word("whether the device measures its orientation")]
    in_rows: Annotated[int, word("fields of a packet from the device")]
    out_rows: Annotated[int, word("fields of a packet to the device")]
    in_table: Annotated[int, address("(in_rows, ROW) float64")]
    out_table: Annotated[int, address("(out_rows, ROW) float64")]
    scratch_word: Annotated[int, word("buffer for one field")]
    last_position: Annotated[int, numbers("last position of a delta mechanism, m", 3)]
    values: Annotated[int, numbers("values of the latest packet", SENSED_SIZE)]
    command_values: Annotated[int, numbers("values of the packet being written", COMMANDED_SIZE)]
    model: Annotated[int, numbers("a `FrameConversion`", MODEL_SIZE)]


DESCRIBED: Final = lay_out(Fields, after=BOARD)


def init_described(
    block: Block,
    options: MountedOptions,
    kinematics: Kinematics,
    input_fields: tuple[InputField, ...],
    output_fields: tuple[OutputField, ...],
    big_endian: bool = False,
) -> Mechanism:
    """Initialize the block for a mechanism, and for the numbers in packets from and to the board."""
    at = block.word
    has_wrist = getattr(kinematics, "wrist_counts_per_turn", None) is not None
    has_orientation = has_wrist or any(field.meaning == "qw" for field in input_fields)
    at[DESCRIBED.kind], at[DESCRIBED.has_orientation] = find_kind(kinematics, has_orientation), has_orientation
    at[DESCRIBED.in_rows], at[DESCRIBED.out_rows] = len(input_fields), len(output_fields)
    block.set_address(DESCRIBED.in_table, make_input_table(input_fields, big_endian))
    block.set_address(DESCRIBED.out_table, make_output_table(output_fields, big_endian))
    mechanism = make_mechanism(kinematics, options.force_max_n)
    block.numbers(DESCRIBED.last_position, 3)[:] = mechanism.delta.home
    set_model(block, mechanism, options.mounting)
    return mechanism


def set_model(block: Block, mechanism: Mechanism, mounting: Mounting) -> None:
    block.numbers(DESCRIBED.model, MODEL_SIZE)[:] = flatten(FrameConversion(mechanism, *mounting.frame()))


def make_described_info(block: Block, options: MountedOptions, kinematics: Kinematics, name: str) -> DeviceInfo:
    sensed_dof = 6 if block.word[DESCRIBED.has_orientation] else kinematics.dof
    return make_info(options, name, sensed_dof, kinematics.dof, options.mounting.position_m)


@jit
def convert_values(handle: int) -> bool:
    """Convert the latest values into BOARD.sample, except its time. Return False if they contain no pose."""
    at, values = int64_at(handle), float64_at(handle + 8 * DESCRIBED.values)
    model: FrameConversion = unpack_at(MODEL_LIKE, handle + 8 * DESCRIBED.model)
    last_position = float64_at(handle + 8 * DESCRIBED.last_position)
    position, rotation, outcome = forward_kinematics(at[DESCRIBED.kind], model.mechanism, values, last_position)
    if outcome == INVALID:
        return False
    at[DESCRIBED.singular] += outcome == SINGULAR
    store_in_world(handle, model, position, rotation)
    sample = float64_at(handle + 8 * BOARD.sample)
    sample[SAMPLE_BUTTONS], sample[SAMPLE_GRIPPER] = values[BUTTONS], values[GRIPPER]
    return True


@jit
def store_in_world(handle: int, model: FrameConversion, position: Vec3, rotation: Quaternion) -> None:
    """Store a pose of the device's frame in BOARD.sample."""
    position = vec3.add(rotate(model.orientation, position), model.position)
    orientation = (1.0, 0.0, 0.0, 0.0)
    if int64_at(handle)[DESCRIBED.has_orientation] != 0:
        orientation = normalize(multiply(model.orientation, rotation))
    store_pose(float64_at(handle + 8 * BOARD.sample), position, orientation)


@jit
def rotate_force_into_device(handle: int, wrench: Any) -> Vec3:
    """Return the force (3,) N of a wrench in the device's frame."""
    model: FrameConversion = unpack_at(MODEL_LIKE, handle + 8 * DESCRIBED.model)
    return rotate(conjugate(model.orientation), (wrench[0], wrench[1], wrench[2]))


@jit
def encode_force(handle: int, force: Vec3, packet: int) -> int:
    """Encode a force (3,) N, device's frame, into the packet at an address; return FULL, or why it was limited."""
    at, command_values = int64_at(handle), float64_at(handle + 8 * DESCRIBED.command_values)
    for k in range(COMMANDED_SIZE):
        command_values[k] = 0.0
    command_values[CONSTANT] = 1.0
    outcome = FULL
    if not is_zero(force, 3):
        model: FrameConversion = unpack_at(MODEL_LIKE, handle + 8 * DESCRIBED.model)
        values = float64_at(handle + 8 * DESCRIBED.values)
        last_position = float64_at(handle + 8 * DESCRIBED.last_position)
        outcome = compute_command(at[DESCRIBED.kind], model.mechanism, values, last_position, force, command_values)
    scratch_word = handle + 8 * DESCRIBED.scratch_word
    is_limited = encode(command_values, at[DESCRIBED.out_table], at[DESCRIBED.out_rows], scratch_word, packet)
    return LIMITED if is_limited and outcome == FULL else outcome


@jit
def count_limited(handle: int, outcome: int) -> None:
    """Count a force that was limited, by the result of `encode_force`."""
    if outcome != FULL:
        int64_at(handle)[DESCRIBED.singular if outcome == SINGULAR else DESCRIBED.cut] += 1
