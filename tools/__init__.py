"""Scripts that produce what the package ships; not part of the package."""
