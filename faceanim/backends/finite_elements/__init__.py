"""Nonlinear finite elements on linear or quadratic tetrahedra: the reference by which the other backends are judged."""
