"""Verbs of the command line, one per file with `run(args) -> exit code`; `options` has `configure_<verb>(parser)`.

Contains no code that other modules import: code that two verbs share is elsewhere.
"""
