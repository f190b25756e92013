"""Skin as masses and nonlinear springs (Zhang, Prakash & Sung), with the paper's schemes and better ones."""
