"""Change detection between two submaps (CDSD section III-C): pure functions on arrays."""
