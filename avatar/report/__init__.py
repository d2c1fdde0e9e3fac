"""Numbers and pictures -> tables, plots, pages."""
