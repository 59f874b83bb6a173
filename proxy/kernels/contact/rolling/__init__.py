"""Rolling: motion of the contact when the fingertip rotates without slip.

    roll(method, shape, radius, center, normal, turn) -> Roll

Without slip the fingertip's centre c moves on the offset surface, at the distance r from the object, by

    dc/dt = r w x n(c)

with w the angular velocity of the fingertip relative to the object. This is Montana's equation without coordinates. It
is regular wherever the object has a nearest point, including edges and corners, where the contact point is constant
while n rotates. The methods compute the end of this path from the rotation of one tick in different ways:

    euler         euler_zxz and euler_zyx: one straight roll, from the Euler angles of the rotation
    closed        rotation_vector: exact path for a constant w, on shapes with a closed form
    pieces        the same on shapes made of several surfaces
    integrated    midpoint, montana_rk4, montana_rk45: numerical integration for a constant w, on any shape

All methods project the centre onto the offset surface at the end, so none drifts off the object. `on_objects` calls
them for an object in the world.
"""

from softfinger.proxy.kernels.contact.rolling import closed, euler, integrated, pieces
from softfinger.proxy.kernels.contact.rolling.base import OffsetPoint, Roll, roll

__all__ = ["OffsetPoint", "Roll", "closed", "euler", "integrated", "pieces", "roll"]
