"""Measuring: how far, how true, how fast; tables and charts of it."""
