"""A local web page that shows an avatar live: `python -m avatar.play results/SUBJECT/VARIANT`."""
