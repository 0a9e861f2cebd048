"""Other published systems, one package each."""
