"""Entry point of `python -m qgs`, the same as the command `qgs`.

Launchers such as torchrun start the command through this module.
"""

from qgs.cli import main

if __name__ == "__main__":
    main()
