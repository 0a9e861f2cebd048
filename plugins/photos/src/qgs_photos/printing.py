"""Print lines for the user."""

from rich.console import Console


def say(console: Console, text: str) -> None:
    """Print `text` unchanged: without line breaks inside paths, and brackets are not markup."""
    console.print(text, soft_wrap=True, highlight=False, markup=False)
