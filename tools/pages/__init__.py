"""Pages and pictures of docs/ that are made from the program: the reference, and a figure for each model page.

No measurements: those are in the study. No prose beyond a page's heading and its first lines.
"""
