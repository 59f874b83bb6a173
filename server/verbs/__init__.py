"""Verbs of the command line, one per file: `configure(parser)` and `run(args) -> exit code`.

Contains no code that other modules import: code that two verbs share is elsewhere.
"""
