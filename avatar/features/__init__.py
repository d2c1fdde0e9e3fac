"""Sources of the per-vertex features: one module each, chosen by name in `avatar.build`."""
