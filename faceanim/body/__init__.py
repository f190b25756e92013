"""A body is described once, for every backend: surface, tissue, supports, actuators, colliders."""
