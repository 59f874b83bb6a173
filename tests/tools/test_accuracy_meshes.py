"""`accuracy --meshes`: a mesh of a surface comes near to it at the order that geometry says."""

from softfinger.tools.accuracy.meshes import CASES, converge, orders

FINENESS = (16, 32, 64)


def test_a_ball_of_triangles_becomes_the_ball() -> None:
    """Half as long edges: the force and how far the contact point is off the surface are a quarter of what they were,
    since a facet bulges by the square of its size; the force's direction is nearer by half at least, and shaded it
    is so from the start. Nothing steps by more than the angle between two facets."""
    rows = list(converge("ball", FINENESS))
    found = orders(rows)
    assert found["force_n"] > 1.8 and found["point_m"] > 1.8
    assert 0.8 < found["direction_rad"] < 1.5
    for row in rows:
        assert row["shaded_rad"] < 0.5 * row["direction_rad"]
        assert row["shaded_step_rad"] < 2e-3
        # A facet of that edge is at most so far below the ball of 50 mm, which the force feels at 1000 N/m.
        assert row["point_m"] < row["edge_m"] ** 2 / (4.0 * 0.05)
        assert row["force_n"] < 1000.0 * row["edge_m"] ** 2 / (4.0 * 0.05)


def test_triangles_are_wound_outward_and_join() -> None:
    """Each edge of the closed ones has two triangles, one each way; the volume is that of the solid, to the facets."""
    for name in ("ball", "torus"):
        vertices, triangles = CASES[name].triangles(8)
        edges = [tuple(edge) for t in triangles.tolist() for edge in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0]))]
        assert len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)
        a, b, c = (vertices[triangles[:, i]] for i in range(3))
        volume = float((a * _cross(b, c)).sum() / 6.0)
        true = {"ball": 4.0 / 3.0 * 0.05**3 * 3.14159, "torus": 2.0 * 3.14159**2 * 0.05 * 0.02**2}[name]
        assert 0.9 * true < volume < true


def _cross(b, c):
    return b[:, [1, 2, 0]] * c[:, [2, 0, 1]] - b[:, [2, 0, 1]] * c[:, [1, 2, 0]]
