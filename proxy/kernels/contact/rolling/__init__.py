"""One rolling step: where the contact goes when the fingertip turns without slipping.

    roll(method, shape, radius, center, normal, turn) -> Roll

Without slip the fingertip's centre c moves on the surface at distance r from the object, its offset
surface, by

    dc/dt = r w x n(c)

with w the angular velocity of the fingertip against the object. This is Montana's equation without
coordinates, and it is regular wherever the object has a nearest point, on edges and corners too: there
the contact point stands still while n turns. The methods differ in how they get from the rotation of
one tick to the end of this path:

    euler         euler_zxz and euler_zyx: one straight roll, read off the rotation's Euler angles
    closed        rotation_vector: the exact path for a constant w, on shapes that have one
    pieces        the same on shapes made of several surfaces
    integrated    midpoint, montana_rk4, montana_rk45: numerically, for a constant w, on any shape

All end with the centre put back onto the offset surface, so no method drifts off the object.
"""

from softfinger.proxy.kernels.contact.rolling import closed, euler, integrated, pieces
from softfinger.proxy.kernels.contact.rolling.base import OffsetPoint, Roll, roll

__all__ = ["OffsetPoint", "Roll", "closed", "euler", "integrated", "pieces", "roll"]
