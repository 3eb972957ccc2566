"""`python -m handtouch` is the `handtouch` command."""

import sys

from handtouch.cli import main

if __name__ == "__main__":
    sys.exit(main())
