"""`softfinger stability`: the stiffest stable wall, and the tick at the limits of its inputs.

Contains no tick: the tested one is the servo's, and the predictions share no code with it.
"""
