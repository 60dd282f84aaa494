"""`python -m simulators`: a simulated scanner as its own process."""

import sys

from simulators.process import main

sys.exit(main())
