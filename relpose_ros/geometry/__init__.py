"""Pure maths: rotations, their grid, cameras and alignments. No images, no network."""
