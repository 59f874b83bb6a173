"""Services of the daemon: each can be started and stopped, and defines the effect of its failure on the run.

Contains no servo loop and no message format.
"""
