"""`softfinger doctor`: checks of this machine, and a device report for an issue.

Contains no repair: a check only names the remedy.
"""
