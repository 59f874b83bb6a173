"""ROS 2 node: publish the fingertip as PoseStamped and the wrench on the hand as WrenchStamped, 100 times per second.

softfinger run                                  # in one terminal
python3 ros2_node.py [ENDPOINT]                 # in another: with ROS 2 sourced, and softfinger in its Python
"""

import sys
from contextlib import suppress

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3, Wrench, WrenchStamped
from std_msgs.msg import Header

EVERY = 10  # ticks per message


def messages(sample) -> tuple[PoseStamped, WrenchStamped]:
    """Return pose and wrench of a sample in the frame `world`; the torque is about the fingertip's centre."""
    seconds, rest = divmod(round(sample.timestamp * 1e9), 10**9)
    header = Header(stamp=Time(sec=seconds, nanosec=rest), frame_id="world")
    position = Point(**named("xyz", sample["probe.position"]))
    orientation = Quaternion(**named("wxyz", sample["probe.orientation"]))
    force, torque = (Vector3(**named("xyz", sample[key])) for key in ("force", "torque"))
    pose, wrench = Pose(position=position, orientation=orientation), Wrench(force=force, torque=torque)
    return PoseStamped(header=header, pose=pose), WrenchStamped(header=header, wrench=wrench)


def named(names: str, values) -> dict[str, float]:
    return dict(zip(names, values, strict=True))


def main() -> None:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from softfinger import Client

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # Python handles Ctrl-C
    node = rclpy.create_node("softfinger")
    poses = node.create_publisher(PoseStamped, "softfinger/pose", 10)
    wrenches = node.create_publisher(WrenchStamped, "softfinger/wrench", 10)
    with suppress(KeyboardInterrupt):
        for sample in Client(*sys.argv[1:]).subscribe(timeout_s=10.0):
            if sample.tick % EVERY == 0:
                pose, wrench = messages(sample)
                poses.publish(pose)
                wrenches.publish(wrench)


if __name__ == "__main__":
    main()
