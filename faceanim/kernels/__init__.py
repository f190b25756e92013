"""Compiled loops over bare arrays: no class, file, print or raise; the caller allocates and checks."""
