"""`softfinger stability`: the stiffest stable wall, and the tick at the ends of its inputs.

The tick is the servo's own; what is predicted beside it shares no code with it.
"""
