"""Flesh by a weighted residual method: exact solutions of Navier's equation fitted at the boundary (You et al. 2000)."""
