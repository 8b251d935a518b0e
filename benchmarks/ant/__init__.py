"""The off-policy study: its task, one of its runs, and what it found."""
