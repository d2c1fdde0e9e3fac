"""Tracked head -> avatar -> numbers. Steps (verbs) open files; libraries (nouns) are pure. May import `fitting`, `workflow`."""
