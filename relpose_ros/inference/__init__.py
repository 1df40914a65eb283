"""From pair energies to rotations, poses and how far to trust them."""
