"""Ground floor: compilation, arrays, errors and units, used by every other room."""
