"""Entry point of `python -m qgs`, the same as the command `qgs`.

Launchers such as torchrun start modules.
"""

from qgs.cli import main

if __name__ == "__main__":
    main()
