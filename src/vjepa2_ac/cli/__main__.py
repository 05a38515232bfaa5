"""Entry point of `python -m vjepa2_ac.cli`, the same as `vjepa2-ac`."""

import sys

from vjepa2_ac.cli.program import main

sys.exit(main())
