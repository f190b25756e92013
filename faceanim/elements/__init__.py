"""Finite elements as functions of positions: energy, forces and tangent, and the search for equilibrium."""
