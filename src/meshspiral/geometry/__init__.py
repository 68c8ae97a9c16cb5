"""Surfaces in NumPy and numba: meshes, connectivity, spirals, descriptors, patches, remeshing."""
