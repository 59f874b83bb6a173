"""WoodenHaptics' third generation: a board on a serial port that knows its own kinematics.

What a rig may say is in `options`, the text of a frame in `frames`, the system's port in `port`, the exchange of a
tick in `exchange`; `device` puts them together.

What every board on a file descriptor does is not in here but in `drivers.conversation`.
"""
