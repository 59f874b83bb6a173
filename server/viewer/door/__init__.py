"""Access to the page: its process, its secret address and its access control.

Only `access` imports packages of viser.
"""
