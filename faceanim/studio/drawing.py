"""Who draws: one thread at a time, since the renderer's parallel loops cannot be run by two at once."""

from __future__ import annotations

import threading

DRAWING = threading.Lock()
"""Hold it while anything of `faceanim.render` draws."""
