"""Linear elastic bodies: volume mesh, finite elements, and the compliance of the surface, computed before the loop."""
