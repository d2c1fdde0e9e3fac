"""Our renders and published ones on the same frames of a comparison video."""
