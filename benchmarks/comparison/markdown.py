"""Tables as Markdown, in the narrow form that a diff shows row by row."""

from collections.abc import Sequence


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> str:
    """A table; after some columns of text, those of numbers are aligned to the right."""
    aligned = ["---" if column < texts else "---:" for column in range(len(head))]
    return "".join(f"| {' | '.join(row)} |\n" for row in (head, aligned, *rows))
