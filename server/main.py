"""`python -m softfinger`: the command line. The wheel installs this file as softfinger/__main__.py."""

import sys

from softfinger.server.cli import main

if __name__ == "__main__":
    sys.exit(main())
