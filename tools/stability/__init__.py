"""`softfinger stability`: the stiffest stable wall, and the tick at the ends of its inputs."""
