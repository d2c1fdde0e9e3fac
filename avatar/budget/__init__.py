"""`train.budget`: what to train, and for how long, decided by short measured trials; every decision has its reason."""
