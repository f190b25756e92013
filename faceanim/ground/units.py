"""Units: millimetre, kilogram, second; hence force in mN, stress in kPa, stiffness in mN/mm."""

TISSUE_DENSITY = 1.04e-6
"""Density of soft tissue [kg/mm^3] (1040 kg/m^3)."""
