"""What the command line does with recordings: make one from the wire, tell what is in it, export it, replay it.

No formats: how a file is written and read is beside this folder.
"""
