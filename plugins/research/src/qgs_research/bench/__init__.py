"""How fast and how large models are: any number of recipes, measured in turn in one run."""
