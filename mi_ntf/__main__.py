"""Entry point of `python -m mi_ntf`, the command `mi-ntf`."""

import sys

from mi_ntf.cli import main

if __name__ == "__main__":
    sys.exit(main())
