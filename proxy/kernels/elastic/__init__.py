"""Contact with an elastic surface: `spots.py`, the compliance at the contacts; `step.py`, the contact step."""
