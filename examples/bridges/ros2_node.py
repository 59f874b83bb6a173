"""A node of ROS 2: the fingertip as PoseStamped and the force on the hand as WrenchStamped, 100 times a second.

    softfinger run                                  # in one terminal
    python3 ros2_node.py                            # in another: ROS 2 is sourced, its Python has softfinger

`/softfinger/pose` is in the frame `world`. `/softfinger/wrench` acts at the fingertip's centre, and RViz draws it at
the origin of its frame: so it is in the frame `fingertip`, which is on `/tf`. Ticks between two messages are left out.
"""

from types import SimpleNamespace

import numpy as np

EVERY = 10  # ticks a message


def messages(ros: SimpleNamespace, sample) -> tuple:
    """PoseStamped, WrenchStamped and TransformStamped of a contact message; `ros` has the classes by name."""
    seconds, rest = divmod(round(sample.timestamp * 1e9), 10**9)
    stamp = ros.Time(sec=seconds, nanosec=rest)
    world, fingertip = (ros.Header(stamp=stamp, frame_id=frame) for frame in ("world", "fingertip"))
    x, y, z = sample["probe.position"]
    w, *v = sample["probe.orientation"]  # ROS has w last
    turn = ros.Quaternion(x=v[0], y=v[1], z=v[2], w=w)
    force, torque = (into_fingertip(w, v, sample[key]) for key in ("force", "torque"))
    wrench = ros.Wrench(force=ros.Vector3(**force), torque=ros.Vector3(**torque))
    frame = ros.Transform(translation=ros.Vector3(x=x, y=y, z=z), rotation=turn)
    return (
        ros.PoseStamped(header=world, pose=ros.Pose(position=ros.Point(x=x, y=y, z=z), orientation=turn)),
        ros.WrenchStamped(header=fingertip, wrench=wrench),
        ros.TransformStamped(header=world, child_frame_id="fingertip", transform=frame),
    )


def into_fingertip(w: float, v: list[float], vector) -> dict[str, float]:
    """A vector of the world in the fingertip's axes: turned by the conjugate of its orientation."""
    axis = -np.array(v)
    turned = vector + 2.0 * np.cross(axis, np.cross(axis, vector) + w * np.array(vector))
    return dict(zip("xyz", turned.tolist(), strict=True))


def main() -> None:
    import builtin_interfaces.msg
    import geometry_msgs.msg
    import rclpy
    import std_msgs.msg
    from tf2_ros import TransformBroadcaster

    from softfinger import Client

    ros = SimpleNamespace(**vars(geometry_msgs.msg), Header=std_msgs.msg.Header, Time=builtin_interfaces.msg.Time)
    rclpy.init()
    node = rclpy.create_node("softfinger")
    poses = node.create_publisher(ros.PoseStamped, "softfinger/pose", 10)
    wrenches = node.create_publisher(ros.WrenchStamped, "softfinger/wrench", 10)
    frames = TransformBroadcaster(node)
    with Client() as daemon:
        for sample in daemon.subscribe(timeout_s=10.0):
            if sample.tick % EVERY == 0 and rclpy.ok():
                pose, wrench, frame = messages(ros, sample)
                poses.publish(pose)
                wrenches.publish(wrench)
                frames.sendTransform(frame)


if __name__ == "__main__":
    main()
