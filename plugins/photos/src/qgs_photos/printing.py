"""Lines for the user."""

from rich.console import Console


def say(console: Console, text: str) -> None:
    """Print `text` as it is: paths in it stay whole, brackets are no markup."""
    console.print(text, soft_wrap=True, highlight=False, markup=False)
