"""How steps are run and tracked: the harness (`step`) and the code digest (`digest`). Imports nothing of the project."""
