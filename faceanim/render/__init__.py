"""Off-screen pictures of moving surfaces, drawn by our own rasteriser: no display, no graphics library.

Numbered PNG files, films and contact sheets are written by `sequence`.
"""
