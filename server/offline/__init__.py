"""The servo's tick without its clock: simulation, results files, cost, summaries and figures.

Contains no code that needs a device or real time.
"""
