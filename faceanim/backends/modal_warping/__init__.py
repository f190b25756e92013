"""Linear vibration modes warped by the rotations they imply (Choi & Ko 2005), and two variants that err less."""
