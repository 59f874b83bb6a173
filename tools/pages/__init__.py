"""Generated pages and pictures of docs/: the reference, and a figure for each model page.

Contains no measurements, which are in the study, and no prose except the heading and first lines of a page.
"""
