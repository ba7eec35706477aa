"""`python -m hannes_bringup.cli` is `hannes`."""

import sys

from . import main

sys.exit(main())
