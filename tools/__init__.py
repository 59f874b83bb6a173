"""What an engineer runs by hand: measurements, the doctor, recordings, the study.

Nothing that the daemon needs.
"""
