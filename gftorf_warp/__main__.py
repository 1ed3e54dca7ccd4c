"""``python -m gftorf_warp`` is the same as ``gftorf``."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
