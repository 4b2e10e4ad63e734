"""`python -m mi_ntf` is the command `mi-ntf`."""

import sys

from mi_ntf.cli import main

if __name__ == "__main__":
    sys.exit(main())
