"""What a face is asked to do: action units, expressions made of them, and their course in time."""
