"""`python -m faceanim`: the same as the command `faceanim`."""

from __future__ import annotations

import sys

from faceanim.cli.main import main

sys.exit(main())
