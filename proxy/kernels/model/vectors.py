"""Types of vectors and rotations, as tuples of float64: m, N, rad; quaternions w, x, y, z."""

Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

ZERO: Vec3 = (0.0, 0.0, 0.0)
