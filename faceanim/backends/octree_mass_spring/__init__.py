"""Flesh as masses and springs on an octree of cubes (Ganovelli, Cignoni & Scopigno), with corrected simplification."""
