"""python -m fluidlift.cli"""

import sys

from fluidlift.cli import main

if __name__ == "__main__":
    sys.exit(main())
