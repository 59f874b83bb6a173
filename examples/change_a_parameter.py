"""Change a parameter of a running daemon, and read the effect in its telemetry.

    softfinger run                                  # in one terminal
    python examples/change_a_parameter.py           # in another

`Client` sends commands and receives telemetry. A change takes effect between two ticks, for all fingers, and the
guard limits the slew rate of the force. Optional arguments: endpoints of telemetry and commands.
"""

import sys

from softfinger import Client

STIFFNESS = "object.table.material.stiffness_n_per_m"
SETTLED = 100  # ticks: earlier ones may have been published before the change


def peak(daemon: Client, ticks: int = 1000) -> float:
    """Return the largest normal force (N) in the next `ticks` ticks of contact."""
    forces: list[float] = []
    for sample in daemon.subscribe(timeout_s=10.0):
        if sample.contact.mode != 0:
            forces.append(sample["contact.normal_force"])
        if len(forces) == ticks:
            break
    return max(forces[SETTLED:])


def main(*endpoints: str) -> None:
    with Client(*endpoints) as daemon:
        before = peak(daemon)
        change = daemon.set_params({STIFFNESS: 500.0}).changed[STIFFNESS]
        after = peak(daemon)
        daemon.set_params({STIFFNESS: change.before})
    print(f"{STIFFNESS}: {change.before:g} -> {change.after:g}; largest normal force {before:.2f} N -> {after:.2f} N")


if __name__ == "__main__":
    main(*sys.argv[1:])
