"""Running an expression on a face: a solver stepped under muscle control, frame by frame, and what is kept of it."""
