"""Video -> tracked head. Steps (verbs) open files; libraries (nouns) are pure. May import `workflow`, never `avatar`."""
