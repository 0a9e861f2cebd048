"""Random cases of what users and strangers give, each used in a process of its own."""
