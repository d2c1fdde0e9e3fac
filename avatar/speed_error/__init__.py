"""Error against the seconds and the operations that it costs, of everything that can be chosen, from one run on one machine."""
