"""Sources of features against each other at a small size (paper, section 4.4)."""
