"""The verbs of the command line, one a file: `configure(parser)` and `run(args) -> exit code`.

Nothing that another module needs: what two verbs share lives elsewhere.
"""
