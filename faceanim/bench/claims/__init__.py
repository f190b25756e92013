"""What the papers claim, measured here: each claim one function, one table, one picture and a verdict."""
