"""Readable forms of what is compiled, and truths that share no code with it."""
