"""Posed photographs of single objects: read from a folder, rendered, or taken from CO3D."""
