"""Contact with an elastic surface: compliance at the contacts (`spots.py`), contact step (`step.py`).

Contains no mesh and no solution of the solid (`proxy/elastic`).
"""
