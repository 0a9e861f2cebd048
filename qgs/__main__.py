"""`python -m qgs` is the command `qgs`; launchers such as torchrun start it by this name."""

from qgs.cli import main

if __name__ == "__main__":
    main()
