"""Mixed finite elements: tetrahedra for muscle and fat, shells for skin; with the models that they are compared with."""
