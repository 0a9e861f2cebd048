"""Photos in folders: formats that hold poses beside them, and scenes made of them."""
