"""`python -m sidestep`: the command line."""

import sys

from sidestep.cli import main

sys.exit(main())
