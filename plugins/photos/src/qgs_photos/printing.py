"""Print lines for the user."""

from rich.console import Console


def say(console: Console, text: str) -> None:
    """Print `text` unchanged: do not break lines, and do not read brackets as markup."""
    console.print(text, soft_wrap=True, highlight=False, markup=False)
