"""Components of the package, in a package of their own."""
