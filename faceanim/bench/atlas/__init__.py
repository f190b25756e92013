"""Stability maps: what each scheme makes of steps, stiffness, activation, turns and bad starts, cell by cell."""
