"""The servo loop: everything that runs, or is shared, between two ticks. Real time starts and ends here.

No socket, no file and no terminal.
"""
