"""What flesh is made of: material parameters with units and sources."""
