"""Programs that an engineer runs by hand: measurements, doctor, recordings, study, and the pages of docs/.

Contains no code that the daemon needs.
"""
